"""Diagnostics that withdraw a bound: the trials contradict the Gaussian process, or they do not cover the tasks.

Each trial is predicted from those before it, and from all others.

Under the process, the standardised error of each prediction from the trials before it follows a t distribution, and
these errors are independent, whatever chose the tasks (recursive residuals; Brown, Durbin and Evans 1975). The order of
trials that people chose or imported has no meaning, so each of them is predicted from all others. Its standardised
error follows a t distribution as well (externally studentised residuals; Cook and Weisberg 1982), if the tasks were
not chosen by the distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri, stdtr

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import ShortRepr
from ctxval.certificates.covering import RESOLUTION, bare_corners, covering, farthest_task
from ctxval.gp.hyperposterior import Conditioned

LEVEL = 0.01
"""Significance level: a surprise that is less probable than this withdraws the bound."""


@dataclass(frozen=True)
class Diagnosis(ShortRepr):
    """How well the process predicts its own data.

    Attributes:
        surprise: p-value of the largest error upward: the probability, under the process, that the largest one of all
            trials is at least as large.
        trial: number of the trial with the largest error upward.
        left_out: root mean square of the standardised leave-one-out errors; about 1 if the process fits the data.
        farthest: largest distance from a task to its nearest trial, in diagonals of the task space.
        doubt: why the bound is withdrawn, in one sentence; None if it is not.
    """

    surprise: float
    trial: int
    left_out: float
    farthest: float
    doubt: str | None

    def to_json(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {name: value for name, value in asdict(self).items() if name != "doubt"}


def diagnose(
    conditioned: list[Conditioned],
    X: Array,
    numbers: Sequence[int] | None = None,
    *,
    unordered: Mask | None = None,
    level: float = LEVEL,
    resolution: float = RESOLUTION,
    covered: Array | None = None,
) -> Diagnosis:
    """Return how well the values agree with the process, and how well the trials cover the tasks.

    Args:
        conditioned: processes conditioned on the values in the order of the trials, one for each draw of the
            hyperparameters.
        X: the trials' points ``(n, d)``, with ``numbers``; 0, 1, ... by default.
        unordered: which trials have an order without meaning, shape ``(n,)``; none by default.
        level: a surprise that is less probable than this withdraws the bound.
        resolution: a task that is farther than this from every trial withdraws the bound, in diagonals.
        covered: points that cover tasks, if there are more than X.
    """
    exceed, before = _surprises(conditioned, np.zeros(len(X), dtype=bool) if unordered is None else unordered)
    worst = int(np.nanargmin(exceed))
    trial = worst if numbers is None else numbers[worst]
    tested = int(np.isfinite(exceed).sum())
    surprise = float(-np.expm1(tested * np.log1p(-min(exceed[worst], 1 - 1e-16))))
    left_out = float(np.sqrt(np.mean([_left_out(process) for process in conditioned])))
    covering_points = X if covered is None else covered
    farthest, d, doubt = farthest_task(covering_points), X.shape[1], None
    if surprise < level:
        doubt = (
            f"trial {trial} came out {-ndtri(max(exceed[worst], 1e-300)):.1f} standard deviations above what the "
            f"{'trials before it' if before[worst] else 'other trials'} predict: the distance is not as smooth as the "
            "bound assumes, so the bound is withdrawn"
        )
    elif farthest > resolution:
        missing = covering(covering_points, resolution, 100)
        many = "more than 100" if missing is None else f"{len(missing)}"
        doubt = (
            f"some task is {farthest:.2g} of the task space's diagonal away from every trial, more than the resolution "
            f"of {resolution:g}, so the bound is withdrawn; {many} more executions would come near to every task "
            "(`ctxval run` makes them), or an audit bounds how many tasks are worse"
        )
    elif bare := len(bare_corners(covering_points, resolution)):
        where = "ends of the task parameter's range" if d == 1 else "corners of the task space"
        doubt = (
            f"no trial is at or next to {bare} of the {2**d} {where}, towards which the distance may rise unseen, so "
            f"the bound is withdrawn; {bare} more executions would be there (`ctxval run` makes them)"
        )
    return Diagnosis(surprise, trial, left_out, farthest, doubt)


def _surprises(conditioned: list[Conditioned], unordered: Mask) -> tuple[Array, Mask]:
    """Return upper tail probabilities ``(n,)``, NaN if not tested, and which trials are predicted from earlier ones."""
    exceed = np.full(len(unordered), np.nan)
    before = ~unordered
    exceed[2:] = np.mean([_exceedances(process) for process in conditioned], axis=0)
    if unordered.any():
        exceed[unordered] = np.mean([_left_out_exceedances(process) for process in conditioned], axis=0)[unordered]
    return exceed, before


def _left_out_exceedances(conditioned: Conditioned) -> Array:
    """Return the upper tail probability of each value given all others, shape ``(n,)``."""
    y, n = conditioned.y, len(conditioned.y)
    inverse = conditioned.factor.solve(np.eye(n))
    ones = inverse.sum(axis=1)
    inverse = inverse - np.outer(ones, ones) / ones.sum()  # the unknown mean is projected out
    pull, diagonal = inverse @ y, np.maximum(np.diag(inverse), np.finfo(np.float64).tiny)
    freedom = n - 2
    scale2 = np.maximum(y @ pull - pull**2 / diagonal, np.finfo(np.float64).tiny) / freedom
    return np.asarray(stdtr(freedom, -pull / np.sqrt(diagonal * scale2)))


def _exceedances(conditioned: Conditioned) -> Array:
    """Return the upper tail probabilities of values 3 to n, each given those before it, shape ``(n - 2,)``."""
    y = conditioned.y
    whitened = conditioned.factor.whiten(np.stack([np.ones(len(y)), y], axis=1))
    a, b = whitened.T
    precision = np.cumsum(a**2)
    means = np.cumsum(a * b) / precision
    residuals = (b[1:] - a[1:] * means[:-1]) / np.sqrt(1 + a[1:] ** 2 / precision[:-1])
    freedom = np.arange(1, len(residuals))
    scales = np.sqrt(np.cumsum(residuals**2)[:-1] / freedom)
    return np.asarray(stdtr(freedom, -residuals[1:] / np.maximum(scales, np.finfo(np.float64).tiny)))


def _left_out(conditioned: Conditioned) -> float:
    """Return the mean square of the standardised leave-one-out errors (Rasmussen and Williams 2006, eq. 5.12)."""
    y = conditioned.y
    inverse = conditioned.factor.solve(np.eye(len(y)))
    pull = inverse @ (y - conditioned.mean)
    return float(np.mean(pull**2 / np.diag(inverse)) / conditioned.scale2)
