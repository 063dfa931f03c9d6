r"""The Gaussian-process bound: the posterior of ``d* = max_p d(p)`` given all trials, however they were chosen.

The bound is an order statistic of draws of d*. Under the prior, S independent draws and the truth are exchangeable, so
the truth is at most the k-th smallest draw with probability ``k / (S + 1)``; groups of draws share hyperparameters, so
this holds approximately. The bound is withdrawn if the trials contradict the process or do not cover the tasks
(:func:`diagnose`). Each trial is predicted from those before it: the standardised errors are independent and follow t
distributions, whatever chose the tasks (recursive residuals; Brown, Durbin and Evans 1975). The order of trials that
people chose or imported has no meaning, so each of them is predicted from all others (externally studentised residuals;
Cook and Weisberg 1982).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask
from ctxval._util.checked import PositiveFloat, Probability, checked
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.covering import RESOLUTION, bare_corners, covering, farthest_task, resolved_volume
from ctxval.certificates.maxima import MAXIMA, Maxima, draw_maxima, representative, settle_maxima
from ctxval.certificates.sample import Sample
from ctxval.certificates.sentences import statements, withdrawals
from ctxval.errors import CertificateError, InputError
from ctxval.gp.acquisition import UpperConfidenceBound, maximise
from ctxval.gp.hyperposterior import Conditioned
from ctxval.gp.surrogate import fit_surrogate


@part("posterior")
@dataclass(frozen=True, repr=False)
class DistanceBound(CertificateKind):
    """Bound on d* from the posterior of a Gaussian process of the distance.

    If two executions of one task differ, the bound is one on the largest expected distance.
    """

    name: ClassVar[str] = "posterior"

    #: largest distance from a task to its nearest trial, in diagonals of the task space; beyond it the bound is
    #: withdrawn. With 1 it is never withdrawn for this reason.
    resolution: PositiveFloat = RESOLUTION

    @checked
    def certify(self, sample: Sample, confidence: Probability = 0.95) -> Certificate:
        """Return the bound that d* stays below with the confidence.

        Raises:
            CertificateError: if a task is too far from all trials.
        """
        threshold = sample.threshold
        far = (farthest := farthest_task(sample.points)) > self.resolution
        # Many trials that do not cover the tasks are refused before the draws, which take long.
        if far and len(sample) > MAXIMA.most:
            raise CertificateError(
                f"some task is {farthest:.2g} of the task space's diagonal away from each of {len(sample)} trials, "
                f"more than the resolution of {self.resolution:g}, so the bound would be withdrawn and is not "
                f"computed; {withdrawals.AUDIT}."
            )
        # A bound that is withdrawn in any case need not be told from the threshold.
        drawn = draw_maxima(sample) if threshold is None or far else settle_maxima(sample, threshold, confidence)
        return self.certify_drawn(sample, drawn, confidence)

    @checked
    def certify_drawn(self, sample: Sample, drawn: Maxima, confidence: Probability = 0.95) -> Certificate:
        """Return the certificate from draws of d*, which were made from the same trials."""
        used, processes, stochastic = representative(sample), drawn.conditioned, drawn.stochastic
        upper, error = drawn.upper(confidence), drawn.error(confidence)
        manual, resolution = np.array([origin == "manual" for origin in used.origins]), self.resolution
        diagnosis = diagnose(
            processes, used.points, used.numbers, unordered=manual, resolution=resolution, covered=sample.points
        )
        hyperparameters = [process.hyperparameters for process in processes]
        rough, d = float(np.mean([each.nu == 1.5 for each in hyperparameters])), sample.points.shape[1]
        assumed = statements.posterior_assumptions(sample, len(used), resolution, stochastic=stochastic)
        details = {
            "best": sample.best,
            "gap": upper - sample.best,
            "error": error,
            "draws": len(drawn.draws),
            "stochastic": stochastic,
            "resolution": {
                "diagonals": resolution,
                "of_each_range": resolution * float(np.sqrt(d)),
                "of_the_space": resolved_volume(resolution, d),
            },
            "instantaneous": instantaneous_bound(used),
            "kernels": {"matern-3/2": rough, "matern-5/2": 1 - rough},
            "logarithm": float(np.mean([np.isfinite(process.warp.offset) for process in processes])),
            "length_scales": np.median(np.exp([each.log_scales for each in hyperparameters]), axis=0).tolist(),
            "diagnosis": {name: value for name, value in vars(diagnosis).items() if name not in ("code", "doubt")},
        }
        statement = statements.posterior_statement(upper, error, confidence, stochastic=stochastic)
        doubt = statements.both_outcomes(sample, stochastic=stochastic) or diagnosis.doubt
        by = None if doubt is None else diagnosis.code or "executions_differ"
        withdrawn: dict[str, Any] = {"doubt": doubt, "withdrawn_by": by}
        return self.certificate(sample, statement, upper, confidence, assumed, details, error=error, **withdrawn)


def instantaneous_bound(sample: Sample) -> dict[str, float] | None:
    """Return the largest UCB of the paper's GP with estimated hyperparameters, and its gap to the best distance found.

    It is below d* about as often as above. It is None if fewer than two distances are known.
    """
    try:
        surrogate = fit_surrogate(sample.points, sample.distances)
    except InputError:
        return None
    beta = 2.0
    bound = UpperConfidenceBound(surrogate.process, beta)
    best_first = sample.points[np.argsort(-sample.distances, kind="stable")]
    point = maximise(bound, sample.points.shape[1], best_first, np.random.default_rng(0))
    largest = surrogate.shift + surrogate.scale * float(bound(point[None])[0])
    return {"max_ucb": largest, "gap": largest - float(sample.distances.max()), "beta": beta}


LEVEL = 0.01
"""Significance level: a surprise that is less probable than this withdraws the bound."""


@dataclass(frozen=True)
class Diagnosis(ShortRepr):
    """How well the process predicts its own data."""

    surprise: float  #: the probability, under the process, that the largest error upward is at least as large
    trial: int  #: number of the trial with the largest error upward
    left_out: float  #: root mean square of the standardised leave-one-out errors; about 1 if the process fits the data
    farthest: float  #: largest distance from a task to its nearest trial, in diagonals of the task space
    code: str | None  #: what withdraws the bound; None if nothing does
    doubt: str | None  #: why, in one sentence; None if it is not withdrawn


def diagnose(
    conditioned: list[Conditioned],
    X: Array,
    numbers: Sequence[int] | None = None,
    *,
    unordered: Mask | None = None,
    resolution: float = RESOLUTION,
    covered: Array | None = None,
) -> Diagnosis:
    """Return how well the values agree with the processes, and how well the trials cover the tasks.

    Args:
        X: the trials' points ``(n, d)``, in the order of the values, with ``numbers``; 0, 1, ... by default.
        unordered: which trials have an order without meaning, shape ``(n,)``; none by default.
        resolution: a task that is farther than this from every trial withdraws the bound, in diagonals.
        covered: points that cover tasks, if there are more than X.
    """
    exceed = np.full(len(X), np.nan)  # upper tail probabilities; NaN if not tested
    exceed[2:] = np.mean([_exceedances(process) for process in conditioned], axis=0)
    if unordered is not None and unordered.any():
        exceed[unordered] = np.mean([_left_out_exceedances(process) for process in conditioned], axis=0)[unordered]
    worst = int(np.nanargmin(exceed))
    trial = worst if numbers is None else numbers[worst]
    tested = int(np.isfinite(exceed).sum())
    surprise = float(-np.expm1(tested * np.log1p(-min(exceed[worst], 1 - 1e-16))))
    left_out = float(np.sqrt(np.mean([_left_out(process) for process in conditioned])))
    covered = X if covered is None else covered
    farthest, d, code, doubt = farthest_task(covered), X.shape[1], None, None
    if surprise < LEVEL:
        others = "other trials" if unordered is not None and unordered[worst] else "trials before it"
        deviations = -scipy.special.ndtri(max(exceed[worst], 1e-300))
        code, doubt = "surprising", withdrawals.SURPRISING.format(trial=trial, deviations=deviations, others=others)
    elif farthest > resolution:
        missing = covering(covered, resolution, 100)
        many = "more than 100" if missing is None else f"{len(missing)}"
        code, doubt = "far_task", withdrawals.FAR_TASK.format(farthest=farthest, resolution=resolution, many=many)
    elif bare := len(bare_corners(covered, resolution)):
        where = "ends of the task parameter's range" if d == 1 else "corners of the task space"
        code, doubt = "bare_corners", withdrawals.BARE_CORNERS.format(bare=bare, corners=2**d, where=where)
    return Diagnosis(surprise, trial, left_out, farthest, code, doubt)


def _left_out_exceedances(conditioned: Conditioned) -> Array:
    """Return the upper tail probability of each value given all others, shape ``(n,)``."""
    y, n = conditioned.y, len(conditioned.y)
    inverse = conditioned.factor.solve(np.eye(n))
    ones = inverse.sum(axis=1)
    inverse = inverse - np.outer(ones, ones) / ones.sum()  # the unknown mean is projected out
    pull, diagonal = inverse @ y, np.maximum(np.diag(inverse), np.finfo(np.float64).tiny)
    freedom = n - 2
    scale2 = np.maximum(y @ pull - pull**2 / diagonal, np.finfo(np.float64).tiny) / freedom
    return np.asarray(scipy.special.stdtr(freedom, -pull / np.sqrt(diagonal * scale2)))


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
    return np.asarray(scipy.special.stdtr(freedom, -residuals[1:] / np.maximum(scales, np.finfo(np.float64).tiny)))


def _left_out(conditioned: Conditioned) -> float:
    """Return the mean square of the standardised leave-one-out errors (Rasmussen and Williams 2006, eq. 5.12)."""
    y = conditioned.y
    inverse = conditioned.factor.solve(np.eye(len(y)))
    pull = inverse @ (y - conditioned.mean)
    return float(np.mean(pull**2 / np.diag(inverse)) / conditioned.scale2)
