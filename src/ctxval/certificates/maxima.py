r"""Draws of ``d* = max_p d(p)`` from its posterior given all trials, however they were chosen.

Paths of the Gaussian process are drawn from the posterior, and each is maximised over the task space. Smoothness,
length-scales, mean, variance and noise are drawn from their posterior too, instead of being fixed at estimates. A draw
that is smoother than one from the well-spread trials alone is made as rough as that one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.progress import advance, stage
from ctxval._util.representation import ShortRepr
from ctxval.certificates.bounds import ERRORS, rank_within
from ctxval.certificates.sample import Sample, advice_to_remeasure, listed
from ctxval.certificates.sentences.withdrawals import AUDIT
from ctxval.errors import CertificateError
from ctxval.gp.hyperposterior import EXACT, Conditioned, Prior, draw_hyperparameters, draw_paths, maxima
from ctxval.gp.surrogate import kept_rows


@dataclass(frozen=True)
class MaximaSettings:
    """How maxima of the process are drawn."""

    fewest: int = 4  #: trials for a bound
    most: int = 160  #: trials that a process is conditioned on; the effort of a draw grows with its cube
    #: bounds of the noise variance of a stochastic system, relative to that of the distance
    stochastic: tuple[float, float] = (1e-6, 1.0)
    chains: int = 4  #: those of a bound near a threshold; one chain is usual


MAXIMA = MaximaSettings()
"""The settings in use."""


_EXTREME = 1e100  # largest distance, and inverse of the smallest difference: their squares must be finite


@dataclass(frozen=True, eq=False)
class Maxima(ShortRepr):
    """Draws of d* from its posterior."""

    draws: Array  #: the draws in ascending order, shape ``(S,)``
    points: Array  #: a maximiser of each draw's path, in the unit cube, shape ``(S, d)``
    conditioned: list[Conditioned]  #: the processes under each draw of the hyperparameters
    owners: Rows  #: index into ``conditioned`` of each draw, shape ``(S,)``
    stochastic: bool = False  #: whether executions of one task may differ, so that d* is the largest expected one

    def upper(self, confidence: float) -> float:
        """Return the bound on d* that holds with this probability; a CertificateError if that needs more draws."""
        made = f"the {len(self.draws)} draws of d* that were made"
        return float(self.draws[rank_within(confidence, len(self.draws), made) - 1])

    def error(self, confidence: float) -> float:
        """Return the standard error of the bound over seeds of the draws, by a block bootstrap over their chain.

        Successive draws are correlated. If the confidence is high, few draws are above the bound and their spread may
        be too small; the error of the bound with fewer draws below it is then returned, if it is larger.
        """
        blocks = min(32, len(self.conditioned))
        if blocks < 2:
            return 0.0
        block_of = self.owners * blocks // len(self.conditioned)
        times = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1 / blocks), size=200)
        weights = np.cumsum(times[:, block_of], axis=1, dtype=np.float64)
        total = weights[:, -1:]

        def spread(share: float) -> float:
            rows = (weights < np.minimum(share * (total + 1), total)).sum(axis=1)
            return float(self.draws[np.minimum(rows, len(self.draws) - 1)].std(ddof=1))

        return max(spread(confidence), spread(1 - (1 - confidence) / np.sqrt(2)))

    def probability(self, threshold: float) -> float:
        """Return a lower estimate of Pr(d* <= threshold): the number of draws that keep it, divided by S + 1."""
        return float((self.draws <= threshold).sum() / (len(self.draws) + 1))


def draw_maxima(
    sample: Sample,
    *,
    draws: int = 128,
    paths: int = 8,
    seed: int = 0,
    stochastic: bool | None = None,
    prior: Prior | None = None,
) -> Maxima:
    """Return draws of d* given the trials: of hyperparameters, and of so many paths for each.

    If the system is stochastic, d* is the largest expected distance. By default it is stochastic if two executions of
    one task differ. ``prior`` is that of the hyperparameters.
    """
    if stochastic is None:
        stochastic = sample.repeats_differ
    used = representative(sample)
    _require_bounding(used)
    X, y = used.points, used.distances
    rng = np.random.default_rng(seed)
    # No logarithm with noise: the exponential of an expected logarithm is not the expected distance.
    # No second chain on well-spread trials: only all trials together can separate noise from roughness.
    believed = prior or (Prior(noise=MAXIMA.stochastic, offset=None, spread_share=1.0) if stochastic else Prior())
    best_first = X[np.argsort(-y, kind="stable")]
    with single_threaded(), stage("drawing the largest distance", draws * paths, "draws"):
        conditioned = draw_hyperparameters(X, y, draws, rng, believed)
        tops, points = [], []
        for process in conditioned:
            top, where = maxima(draw_paths(process, X, paths, rng), best_first, rng)
            # A path passes through exact values with this tolerance.
            tops.append(process.warp.backward(top + 3.0 * np.sqrt(EXACT) * np.sqrt(process.scale2)))
            points.append(where)
            advance(paths)
    draws_of_d = np.concatenate(tops)
    if not stochastic:
        draws_of_d = np.maximum(draws_of_d, y.max())
    order = np.argsort(draws_of_d, kind="stable")
    owners = np.repeat(np.arange(len(conditioned)), paths)
    return Maxima(draws_of_d[order], np.concatenate(points)[order], conditioned, owners[order], stochastic)


def representative(sample: Sample) -> Sample:
    """Return the trials that the process is conditioned on: of many, the largest, latest and well-spread ones."""
    return sample.rows(kept_rows(sample.points, sample.distances, MAXIMA.most, MAXIMA.most + 1).tolist())


def settle_maxima(sample: Sample, threshold: float, confidence: float) -> Maxima:
    """Return draws of d*, up to four times as many while the threshold is within two standard errors of the bound."""
    pooled = draw_maxima(sample)
    chains = [pooled]
    while len(chains) < MAXIMA.chains and abs(pooled.upper(confidence) - threshold) < ERRORS * pooled.error(confidence):
        more = range(len(chains), 2 * len(chains))
        chains += [draw_maxima(sample, seed=1_000_003 * chain) for chain in more]
        draws, points = (np.concatenate([getattr(chain, name) for chain in chains]) for name in ("draws", "points"))
        before = np.cumsum([0, *(len(chain.conditioned) for chain in chains[:-1])])
        owners = np.concatenate([chain.owners + first for chain, first in zip(chains, before, strict=True)])
        order = np.argsort(draws, kind="stable")
        conditioned = [process for chain in chains for process in chain.conditioned]
        pooled = Maxima(draws[order], points[order], conditioned, owners[order], chains[0].stochastic)
    return pooled


def _require_bounding(sample: Sample) -> None:
    failed = sample.failed - len(sample.numbers_of("unmeasured"))
    if failed:
        raise CertificateError(
            f"{failed} of {len(sample)} executions failed: the distance of their tasks is unknown, so nothing bounds "
            "d*; once the cause is removed, execute the same tasks again and say what it was (`ctxval run` with "
            '--again-failed "...", or `ctxval ask STORE --again N --because "..."` if people execute them): '
            f"{listed(sample.numbers_of('failed'))}.{advice_to_remeasure(sample)}"
        )
    if sample.failed:
        raise CertificateError(
            f"the distance of some task is unknown, so nothing bounds d*.{advice_to_remeasure(sample)}"
        )
    if len(sample) < MAXIMA.fewest:
        raise CertificateError(f"a posterior bound needs at least {MAXIMA.fewest} trials, got {len(sample)}.")
    spread, largest = float(np.ptp(sample.distances)), float(np.abs(sample.distances).max())
    if spread == 0:
        raise CertificateError(
            f"all {len(sample)} distances are {sample.distances[0]:g}: they do not bound d*. Check that the distance "
            f"compares what differs; {AUDIT}."
        )
    if spread < 1e-14 * largest:
        raise CertificateError(f"the distances differ from {largest:g} by rounding alone: they do not bound d*.")
    if spread < 1 / _EXTREME or largest > _EXTREME:
        raise CertificateError(
            f"the largest distance is {largest:g} and they differ by {spread:g}: a posterior bound needs numbers "
            f"between {1 / _EXTREME:g} and {_EXTREME:g}; take other units."
        )
