r"""The Gaussian-process bound: the posterior of ``d* = max_p d(p)`` given all trials, however they were chosen.

Paths are drawn from the posterior, each is maximised over the task space, and the bound is an order statistic of the
maxima: of S independent draws and the truth, all alike under the prior, the truth is at most the k-th smallest draw
with probability ``k / (S + 1)``; ours share hyperparameters by the handful, so that it is nearly so. Smoothness,
length-scales, mean, variance and noise are drawn as well, not plugged in, and made no smoother than the trials that are
spread best say. Bayes' rule does not ask why a task was chosen, nor why the campaign stopped, so the bound holds after
adaptive sampling; what it does rest on is the prior, and :mod:`ctxval.certificates.diagnostics` says when the trials
speak against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.representation import call
from ctxval.certificates.base import (
    ERRORS,
    ONE_CAMPAIGN,
    Certificate,
    Sample,
    listed,
    remeasure,
    require_probability,
    with_error,
)
from ctxval.certificates.covering import RESOLUTION, require_resolution, resolved_volume
from ctxval.certificates.diagnostics import diagnose
from ctxval.errors import CertificateError, InputError
from ctxval.gp.acquisition import UpperConfidenceBound, maximise
from ctxval.gp.hyperposterior import EXACT, Conditioned, Prior, draw_hyperparameters
from ctxval.gp.sample_paths import draw_paths, maxima
from ctxval.gp.surrogate import fit_surrogate

FEWEST = 4
"""Trials without which nothing is said."""

STOCHASTIC = (1e-6, 1.0)
"""Bounds of the noise variance of a stochastic system, relative to the variance of the distance."""

_ROUNDING = 1e-14
"""Distances that differ by less, relative to their size, are one distance and rounding."""

_EXTREME = 1e100
"""Distances beyond it, or that differ by less than its inverse, have squares that no float holds."""

_REPEATED = 1e-6
"""Two executions of a task may differ by so much of all distances' spread where the system is deterministic."""

_LOTS = 32
"""Parts of the chain of hyperparameters that are resampled for the error of a bound."""

_RESAMPLES = 200

_SEEDS = 1_000_003
"""Between the seeds of chains whose draws are taken together."""

_MOST = 4
"""Times as many draws of d* as usual that a bound near a threshold may take."""

_EXACTNESS = 3.0 * np.sqrt(EXACT)
"""How far a path may miss exact values, in standard deviations of the distance."""


@dataclass(frozen=True, eq=False)
class Maxima:
    """Draws of d* from its posterior.

    Attributes:
        draws: sorted, shape ``(S,)``.
        points: a maximiser of each, in the unit cube, shape ``(S, d)``.
        conditioned: the hyperparameters drawn.
        owners: under which of them each was drawn, shape ``(S,)``.
    """

    draws: Array
    points: Array
    conditioned: list[Conditioned]
    owners: Rows

    def upper(self, confidence: float) -> float:
        """Return the bound that holds with this probability.

        Raises:
            CertificateError: so high a confidence needs more draws.
        """
        rank = max(1, int(np.ceil((len(self.draws) + 1) * require_probability("confidence", confidence) - 1e-9)))
        if rank > len(self.draws):
            raise CertificateError(
                f"a confidence of {confidence:g} needs more than the {len(self.draws)} draws of d* that there are."
            )
        return float(self.draws[rank - 1])

    def error(self, confidence: float) -> float:
        """Return the standard error of the bound: what it differs by from one seed of the draws to another.

        Of lots of the hyperparameters' chain, drawn with replacement: draws that follow each other are alike, and so
        are those that share their hyperparameters. Few draws are above a bound of a high confidence, so that their own
        spread may be too small; the bound with less of them above it has one too, and the larger of the two is taken.
        """
        share = require_probability("confidence", confidence)
        lots = min(_LOTS, len(self.conditioned))
        if lots < 2:
            return 0.0
        lot_of = self.owners * lots // len(self.conditioned)
        times = np.random.default_rng(0).multinomial(lots, np.full(lots, 1 / lots), size=_RESAMPLES)
        weights = np.cumsum(times[:, lot_of], axis=1, dtype=np.float64)
        total = weights[:, -1:]

        def spread(confidence: float) -> float:
            rows = (weights < np.minimum(confidence * (total + 1), total)).sum(axis=1)
            return float(self.draws[np.minimum(rows, len(self.draws) - 1)].std(ddof=1))

        return max(spread(share), spread(1 - (1 - share) / np.sqrt(2)))

    def probability(self, threshold: float) -> float:
        """Return Pr(d* <= threshold), rounded down to what so many draws can tell."""
        return float((self.draws <= threshold).sum() / (len(self.draws) + 1))

    def __repr__(self) -> str:
        return call(self, len(self.draws), draws=self.draws, points=self.points, hyperparameters=len(self.conditioned))


def draw_maxima(
    sample: Sample,
    *,
    draws: int = 128,
    paths: int = 8,
    seed: int = 0,
    stochastic: bool = False,
    prior: Prior | None = None,
) -> Maxima:
    """Return draws of d* given the trials.

    Args:
        sample: trials of any origin.
        draws: of hyperparameters.
        paths: for each of them.
        seed: of the draws.
        stochastic: whether two executions of one task may differ; then d* is the largest expected distance.
        prior: of the hyperparameters.

    Raises:
        CertificateError: an execution failed, or the trials are too few or all alike.
    """
    X, y = _required(sample)
    if not stochastic:
        _require_one_distance_each(sample)
    rng = np.random.default_rng(seed)
    # Noise on the logarithms would bound the median: the expected distance is not the exponential of the expected one.
    # And what is noise and what is roughness only all trials together can tell.
    usual = Prior(noise=STOCHASTIC, offset=None, spread_share=1.0) if stochastic else Prior()
    believed = usual if prior is None else prior
    best_first = X[np.argsort(-y, kind="stable")]
    with single_threaded():
        conditioned = draw_hyperparameters(X, y, draws, rng, believed)
        found = [maxima(draw_paths(one, X, paths, rng), best_first, rng) for one in conditioned]
    tops = np.concatenate(
        [
            one.warp.backward(top + _EXACTNESS * np.sqrt(one.scale2))
            for (top, _), one in zip(found, conditioned, strict=True)
        ]
    )
    if not stochastic:
        tops = np.maximum(tops, y.max())
    order = np.argsort(tops, kind="stable")
    owners = np.repeat(np.arange(len(conditioned)), paths)
    return Maxima(tops[order], np.concatenate([where for _, where in found])[order], conditioned, owners[order])


def settle_maxima(
    sample: Sample, threshold: float, confidence: float, *, seed: int = 0, stochastic: bool = False
) -> Maxima:
    """Return draws of d*, up to four times as many as usual while the threshold is within two errors of the bound.

    The first of them are those of :func:`draw_maxima`; the others come from chains of their own.

    Raises:
        CertificateError: as of :func:`draw_maxima`, or so high a confidence needs more draws.
    """
    found = draw_maxima(sample, seed=seed, stochastic=stochastic)
    lots = [found]
    while len(lots) < _MOST and abs(found.upper(confidence) - threshold) < ERRORS * found.error(confidence):
        more = range(len(lots), 2 * len(lots))
        lots += [draw_maxima(sample, seed=_SEEDS * lot + seed, stochastic=stochastic) for lot in more]
        found = _together(lots)
    return found


def _together(lots: list[Maxima]) -> Maxima:
    draws, points = np.concatenate([one.draws for one in lots]), np.concatenate([one.points for one in lots])
    before = np.cumsum([0, *(len(one.conditioned) for one in lots[:-1])])
    owners = np.concatenate([one.owners + first for one, first in zip(lots, before, strict=True)])
    order = np.argsort(draws, kind="stable")
    return Maxima(draws[order], points[order], [each for one in lots for each in one.conditioned], owners[order])


def _required(sample: Sample) -> tuple[Array, Array]:
    failed = sample.failed - len(sample.numbers_of("unmeasured"))
    if failed:
        raise CertificateError(
            f"{failed} of {len(sample)} executions failed: what the distance is there is unknown, so nothing bounds "
            f"d*; once the cause is removed, execute the same tasks again and say what it was (ctxval ask STORE "
            f'--again N --because "..."): {listed(sample.numbers_of("failed"))}.{remeasure(sample)}'
        )
    if sample.failed:
        raise CertificateError(
            f"what the distance is at some task is unknown, so nothing bounds d*.{remeasure(sample)}"
        )
    if len(sample) < FEWEST:
        raise CertificateError(f"a posterior bound needs at least {FEWEST} trials, got {len(sample)}.")
    if np.ptp(sample.distances) == 0:
        raise CertificateError(f"all {len(sample)} distances are {sample.distances[0]:g}: they say nothing of d*.")
    spread, largest = float(np.ptp(sample.distances)), float(np.abs(sample.distances).max())
    if spread < _ROUNDING * largest:
        raise CertificateError(f"the distances differ from {largest:g} by rounding alone: they say nothing of d*.")
    if spread < 1 / _EXTREME or largest > _EXTREME:
        raise CertificateError(
            f"the largest distance is {largest:g} and they differ by {spread:g}: a posterior bound needs numbers "
            f"between {1 / _EXTREME:g} and {_EXTREME:g}; take other units."
        )
    return sample.points, sample.distances


def _require_one_distance_each(sample: Sample) -> None:
    y, numbers = sample.distances, sample.numbers
    _, tasks = np.unique(sample.points, axis=0, return_inverse=True)
    for row, task in enumerate(tasks.ravel()):
        first = int(np.argmax(tasks.ravel() == task))
        if abs(y[row] - y[first]) > _REPEATED * np.ptp(y):
            raise CertificateError(
                f"trials {numbers[first]} and {numbers[row]} executed one task, and their distances are {y[first]:g} "
                f"and {y[row]:g}: the system is not deterministic; say --stochastic to bound the largest expected "
                "distance."
            )


def certify_posterior(
    sample: Sample,
    confidence: float = 0.95,
    *,
    stochastic: bool = False,
    resolution: float = RESOLUTION,
    seed: int = 0,
    found: Maxima | None = None,
) -> Certificate:
    """Return the bound that d* stays below with the confidence, under the prior and given the trials.

    Args:
        sample: trials of any origin.
        confidence: 1 - eps.
        stochastic: whether two executions of one task may differ; then the largest expected distance is bounded.
        resolution: how far from every trial a task may be, in diagonals of the task space, before the bound is
            withdrawn; 1 trusts the process everywhere.
        seed: of the draws.
        found: draws of d* made before, from the same trials.

    Raises:
        CertificateError: an execution failed, the trials are too few or all alike, the confidence is too high, or the
            resolution is not positive.
    """
    require_probability("confidence", confidence)
    require_resolution(resolution)
    maxima_found = draw_maxima(sample, stochastic=stochastic, seed=seed) if found is None else found
    upper, best = maxima_found.upper(confidence), float(sample.distances.max())
    error = maxima_found.error(confidence)
    unordered = np.array([origin == "manual" for origin in sample.origins])
    diagnosis = diagnose(
        maxima_found.conditioned, sample.points, sample.numbers, unordered=unordered, resolution=resolution
    )
    what = "the largest expected distance" if stochastic else "d*"
    statement = (
        f"With probability {confidence} under the prior, given the trials, {what} is at most "
        f"{with_error(upper, error)}{_STANDARD_ERROR if '±' in with_error(upper, error) else ''}."
    )
    return Certificate(
        kind="posterior",
        statement=statement,
        upper_bound=upper,
        confidence=confidence,
        volume=0.0,
        trials=len(sample),
        assumptions=(*_assumptions(stochastic, resolution), *sample.remarks, ONE_CAMPAIGN),
        details={
            "best": best,
            "gap": upper - best,
            "error": error,
            "draws": len(maxima_found.draws),
            "stochastic": stochastic,
            "resolution": _resolution(resolution, sample.points.shape[1]),
            "instantaneous": instantaneous_bound(sample),
            **_summary(maxima_found.conditioned),
            "diagnosis": diagnosis.to_json(),
            "failures": sample.failures,
        },
        doubt=_both_outcomes(sample, stochastic) or diagnosis.doubt,
        error=error,
    )


_STANDARD_ERROR = " (plus or minus one standard error of the random draws that it is computed from)"


def _both_outcomes(sample: Sample, stochastic: bool) -> str | None:
    """Return why failures that were made good for no stated reason withdraw the bound."""
    unexplained = [one for one in sample.made_good if one.because is None]
    if not unexplained:
        return None
    first = unexplained[0]
    what = (
        "a failure has no distance, so that nothing is known of the expected one there"
        if stochastic
        else "the system is not deterministic there"
    )
    return (
        f"trial {first.trial} failed and trial {first.by} executed the same task with success, for no stated reason: "
        f"{what}, and the bound is withdrawn; if the cause was removed in between, execute the task once more and say "
        f'so: ctxval ask STORE --again {first.trial} --because "what was changed"'
    )


def _assumptions(stochastic: bool, resolution: float) -> tuple[str, ...]:
    noise = (
        "executions of one task differ by independent normal noise of one size"
        if stochastic
        else "each task has one distance: the system is deterministic"
    )
    what = "expected distance" if stochastic else "distance, or its logarithm,"
    return (
        f"the {what} is a draw from a Gaussian process: a constant mean, a Matern kernel of "
        "smoothness 3/2 or 5/2, one length-scale for each parameter, all of them unknown and integrated over",
        f"it is as rough in one part of the task space as in another, as far as {resolution:g} of its diagonal from "
        "the trials: a peak in a gap between them, of which no trial shows a trace, is not covered; audit for that",
        noise,
        "how the tasks were chosen and when the campaign stopped does not matter",
    )


def _resolution(resolution: float, dimension: int) -> dict[str, float]:
    """Return the resolution in diagonals, as a share of each parameter's range, and its ball's share of the space."""
    share = resolution * float(np.sqrt(dimension))
    return {"diagonals": resolution, "of_each_range": share, "of_the_space": resolved_volume(resolution, dimension)}


def _summary(conditioned: list[Conditioned]) -> dict[str, object]:
    """Return the hyperparameters in short: medians of the length-scales, and how likely the rougher kernel is."""
    scales = np.exp([one.hyperparameters.log_scales for one in conditioned])
    rough = float(np.mean([one.hyperparameters.nu == 1.5 for one in conditioned]))
    return {
        "kernels": {"matern-3/2": rough, "matern-5/2": 1 - rough},
        "logarithm": float(np.mean([np.isfinite(one.warp.offset) for one in conditioned])),
        "length_scales": np.median(scales, axis=0).tolist(),
    }


def instantaneous_bound(sample: Sample, beta: float = 2.0) -> dict[str, float] | None:
    """Return the largest UCB of the paper's GP, hyperparameters plugged in, and its gap to the best distance found.

    It is below d* about as often as above, and costs a fortieth of a posterior bound. None where nothing can be fitted.
    """
    try:
        surrogate = fit_surrogate(sample.points, sample.distances)
    except InputError:
        return None
    bound = UpperConfidenceBound(surrogate.process, beta)
    best_first = sample.points[np.argsort(-sample.distances, kind="stable")]
    point = maximise(bound, sample.points.shape[1], best_first, np.random.default_rng(0))
    largest = surrogate.shift + surrogate.scale * float(bound(point[None])[0])
    return {"max_ucb": largest, "gap": largest - float(sample.distances.max()), "beta": beta}
