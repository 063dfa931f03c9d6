r"""Draws of ``d* = max_p d(p)`` from its posterior given all trials, however they were chosen.

Paths of the Gaussian process are drawn from the posterior, and each is maximised over the task space. Smoothness,
length-scales, mean, variance and noise are drawn as well, not plugged in, and made no smoother than the trials that are
spread best say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.representation import call
from ctxval.certificates.bounds import ERRORS, require_probability
from ctxval.certificates.sample import Sample, advice_to_remeasure, listed
from ctxval.errors import CertificateError
from ctxval.gp.hyperposterior import EXACT, Conditioned, Prior, draw_hyperparameters
from ctxval.gp.sample_paths import draw_paths, maxima

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
"""How often they are resampled."""

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

    def __repr__(self) -> str:
        return call(self, len(self.draws), draws=self.draws, points=self.points, hyperparameters=len(self.conditioned))

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
            f'--again N --because "..."): {listed(sample.numbers_of("failed"))}.{advice_to_remeasure(sample)}'
        )
    if sample.failed:
        raise CertificateError(
            f"what the distance is at some task is unknown, so nothing bounds d*.{advice_to_remeasure(sample)}"
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
