"""Do the trials speak against the Gaussian process, and do they cover the tasks? When a bound is not to be believed.

Each trial is predicted from those before it, and from all others.

Under the process, the standardised error of each prediction from the trials before it follows a t distribution, and
these errors are independent, whatever chose the tasks (recursive residuals; Brown, Durbin and Evans 1975). Trials that
people chose or imported have no order that means anything; each of them is predicted from all others, and its
standardised error follows a t distribution as well (externally studentised residuals; Cook and Weisberg 1982), if their
tasks were not chosen by the distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_solve, solve_triangular
from scipy.special import ndtri, stdtr

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import record
from ctxval.certificates.covering import RESOLUTION, bare_corners, covering, farthest_task
from ctxval.gp.hyperposterior import Conditioned

LEVEL = 0.01
"""How unlikely a surprise must be for the bound to be withdrawn."""

_MOST = 100
"""Executions up to which it is told how many would cover the tasks."""


@dataclass(frozen=True)
class Diagnosis:
    """How well the process predicts its own data.

    Attributes:
        surprise: the probability that the largest upward surprise of so many trials is as large as the one seen.
        trial: in which trial it was seen.
        left_out: root mean square of the leave-one-out errors in their standard deviations; about 1 if all is well.
        farthest: how far from every trial a task is at most, in diagonals of the task space.
        doubt: one sentence, where the bound is withdrawn.
    """

    surprise: float
    trial: int
    left_out: float
    farthest: float
    doubt: str | None

    def to_json(self) -> dict[str, Any]:
        """Return the numbers."""
        return {"surprise": self.surprise, "trial": self.trial, "left_out": self.left_out, "farthest": self.farthest}

    def __repr__(self) -> str:
        return record(self)


def diagnose(
    conditioned: list[Conditioned],
    X: Array,
    numbers: Sequence[int] | None = None,
    *,
    unordered: Mask | None = None,
    level: float = LEVEL,
    resolution: float = RESOLUTION,
) -> Diagnosis:
    """Return how the values, in the order of the trials, agree with the process, and how well the trials cover it.

    Args:
        conditioned: the values under draws of the hyperparameters.
        X: the trials' points ``(n, d)``.
        numbers: of the trials; 0, 1, ... by default.
        unordered: which trials have no order that means anything, shape ``(n,)``; none by default.
        level: how unlikely a surprise withdraws the bound.
        resolution: how far from every trial a task may be without withdrawing it, in diagonals.
    """
    exceed, before = _surprises(conditioned, np.zeros(len(X), dtype=bool) if unordered is None else unordered)
    worst = int(np.nanargmin(exceed))
    trial = worst if numbers is None else numbers[worst]
    tested = int(np.isfinite(exceed).sum())
    surprise = float(-np.expm1(tested * np.log1p(-min(exceed[worst], 1 - 1e-16))))
    left_out = float(np.sqrt(np.mean([_left_out(one) for one in conditioned])))
    farthest, doubt = farthest_task(X), None
    if surprise < level:
        doubt = (
            f"trial {trial} came out {-ndtri(max(exceed[worst], 1e-300)):.1f} standard deviations above what the "
            f"{'trials before it' if before[worst] else 'other trials'} predict: the distance is not as smooth as the "
            "bound takes it to be, and the bound is withdrawn"
        )
    elif farthest > resolution:
        doubt = _uncovered(X, farthest, resolution)
    elif len(bare := bare_corners(X, resolution)):
        doubt = _bare(bare, len(X[0]))
    return Diagnosis(surprise, trial, left_out, farthest, doubt)


def _uncovered(X: Array, farthest: float, resolution: float) -> str:
    missing = covering(X, resolution, _MOST)
    many = f"more than {_MOST}" if missing is None else f"{len(missing)}"
    return (
        f"some task is {farthest:.2g} of the task space's diagonal away from every trial, more than the "
        f"{resolution:g} within which the distance is taken to be like what was seen, and the bound is withdrawn; "
        f"{many} more executions would come near to every task (--until-decided makes them), or an audit bounds how "
        "many tasks are worse"
    )


def _surprises(conditioned: list[Conditioned], unordered: Mask) -> tuple[Array, Mask]:
    """Return Pr(a value as large) for each trial ``(n,)``, NaN if not tested, and which ones the earlier predict."""
    exceed = np.full(len(unordered), np.nan)
    before = ~unordered
    exceed[2:] = np.mean([_exceedances(one) for one in conditioned], axis=0)
    if unordered.any():
        exceed[unordered] = np.mean([_left_out_exceedances(one) for one in conditioned], axis=0)[unordered]
    return exceed, before


def _left_out_exceedances(conditioned: Conditioned) -> Array:
    """Return Pr(a value as large) for each trial given all others, shape ``(n,)``."""
    y, n = conditioned.y, len(conditioned.y)
    inverse = cho_solve((conditioned.L, True), np.eye(n), check_finite=False)
    ones = inverse.sum(axis=1)
    inverse = inverse - np.outer(ones, ones) / ones.sum()  # the unknown mean is projected out
    pull, own = inverse @ y, np.maximum(np.diag(inverse), np.finfo(np.float64).tiny)
    freedom = n - 2
    scale2 = np.maximum(y @ pull - pull**2 / own, np.finfo(np.float64).tiny) / freedom
    return np.asarray(stdtr(freedom, -pull / np.sqrt(own * scale2)))


def _bare(bare: Array, d: int) -> str:
    where = "ends of the task parameter's range" if d == 1 else "corners of the task space"
    return (
        f"no trial is at or beside {len(bare)} of the {2**d} {where}, towards which the distance may rise unseen, and "
        f"the bound is withdrawn; {len(bare)} more executions would be (--until-decided makes them)"
    )


def _exceedances(conditioned: Conditioned) -> Array:
    """Return Pr(a value as large) for trials 3 to n, given those before each, shape ``(n - 2,)``."""
    y = conditioned.y
    whitened = solve_triangular(conditioned.L, np.stack([np.ones(len(y)), y], axis=1), lower=True, check_finite=False)
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
    inverse = cho_solve((conditioned.L, True), np.eye(len(y)), check_finite=False)
    pull = inverse @ (y - conditioned.mean)
    return float(np.mean(pull**2 / np.diag(inverse)) / conditioned.scale2)
