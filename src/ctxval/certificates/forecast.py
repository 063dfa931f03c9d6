"""Forecast of the executions until a verdict: how many there are at least or about, and what they would decide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval.certificates.maxima import Maxima
from ctxval.certificates.sample import Sample
from ctxval.certificates.verdict_sentences import outlook
from ctxval.gp.hyperposterior import Conditioned

HORIZON = 200
"""Largest number of executions in a simulated future."""

_JITTER = 1e-9  # added to variances, relative to the distance's, so that the covariance of near tasks can be factorised


@dataclass(frozen=True)
class Forecast:
    """Forecast of further executions.

    Attributes:
        executions: number of executions after which half of the simulated futures are decided, or the fewest that can
            decide; None if it exceeds ``HORIZON``.
        validated: share of the futures, or of the posterior samples of the dynamics, that validate the threshold.
        falsified: share of them in which a distance exceeds the threshold.
        fewest: whether ``executions`` is the fewest that can decide.
    """

    executions: int | None
    validated: float
    falsified: float
    fewest: bool = False

    def __str__(self) -> str:
        return outlook(self, HORIZON)


def forecast(
    sample: Sample, found: Maxima, threshold: float, confidence: float, *, seed: int = 0, futures: int = 32
) -> Forecast:
    """Return how many more executions of GP-UCB decide whether d* is at most the threshold, from draws of d*.

    Each future takes one draw of the hyperparameters, from those whose draws of d* exceed the threshold if there are
    any. It draws a true distance function from the posterior on a set of candidate tasks, and searches it with GP-UCB.
    It is decided when a distance above the threshold is executed, or when the upper bound falls to the threshold. The
    bound keeps the number of standard deviations above the mean that it has now.
    """
    rng = np.random.default_rng(seed)
    lengths, kept = [], 0
    with single_threaded():
        in_the_way = found.owners[found.draws > threshold]
        owners = found.owners if not len(in_the_way) else in_the_way
        for k in range(futures):
            conditioned = found.conditioned[owners[k * len(owners) // futures]]
            length, validated = _Future(sample, found, conditioned, confidence, rng).simulate(threshold)
            lengths.append(length)
            kept += validated
    decided = np.isfinite(lengths)
    half = float(np.quantile(lengths, 0.5, method="higher"))
    return Forecast(int(half) if np.isfinite(half) else None, kept / futures, (int(decided.sum()) - kept) / futures)


class _Future:
    """A simulated continuation of the campaign: a posterior on finitely many tasks, and a truth drawn from it."""

    def __init__(
        self, sample: Sample, found: Maxima, conditioned: Conditioned, confidence: float, rng: np.random.Generator
    ) -> None:
        highest = found.points[:: max(1, len(found.points) // 100)]
        candidates = np.concatenate([highest, rng.random((400, sample.points.shape[1]))])
        self.warp = conditioned.warp  # from here on everything is on the process's scale
        self.best = float(self.warp.forward(sample.best))
        self.mean, self.covariance = _joint(conditioned, sample.points, candidates)
        L = np.linalg.cholesky(self.covariance + _JITTER * conditioned.scale2 * np.eye(len(candidates)))
        self.truth = self.mean + L @ rng.normal(size=len(candidates))
        tops = (self.mean[:, None] + L @ rng.normal(size=(len(candidates), 256))).max(axis=0)
        bound, low, high = max(float(np.quantile(tops, confidence)), self.best), 0.0, 20.0
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._upper(middle) < bound else (low, middle)
        self.width = high  # the z at which max (mean + z deviation) is the bound
        # The first bound is that of all draws together: one draw must not decide what all together leave undecided.
        self.bound = max(float(self.warp.forward(found.upper(confidence))), self.best)

    def _deviation(self) -> Array:
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def _upper(self, width: float) -> float:
        return float((self.mean + width * self._deviation()).max())

    def simulate(self, threshold: float) -> tuple[float, bool]:
        """Return the number of executions until it is decided (infinity if never) and whether the threshold is kept."""
        limit = float(self.warp.forward(threshold))
        for executions in range(HORIZON + 1):
            if self.best > limit:
                return executions, False
            if self.bound <= limit:
                return executions, True
            self._execute()
            self.bound = max(self._upper(self.width), self.best)
        return np.inf, False

    def _execute(self) -> None:
        deviation = self._deviation()
        bound = self.mean + np.sqrt(2.0) * deviation  # GP-UCB with beta = 2
        row = int(bound.argmax())
        if deviation[row] <= 1e-6 * max(deviation.max(), 1e-300):
            row = int(deviation.argmax())
        variance = self.covariance[row, row] + _JITTER * np.trace(self.covariance) / len(self.mean) + 1e-300
        pull = self.covariance[:, row] / variance
        self.mean = self.mean + pull * (self.truth[row] - self.mean[row])
        self.covariance = self.covariance - np.outer(pull, self.covariance[row])
        self.best = max(self.best, float(self.truth[row]))


def _joint(conditioned: Conditioned, X: Array, Z: Array) -> tuple[Array, Array]:
    """Return posterior mean ``(m,)`` and covariance ``(m, m)`` at Z, including the uncertainty of the prior's mean."""
    hyperparameters = conditioned.hyperparameters
    k = hyperparameters.kernel(Z, X)
    weights = conditioned.factor.solve(k.T)
    mean = conditioned.mean + weights.T @ (conditioned.y - conditioned.mean)
    missing = 1 - weights.sum(axis=0)
    covariance = hyperparameters.kernel(Z, Z) - k @ weights + conditioned.mean_variance * np.outer(missing, missing)
    return mean, conditioned.scale2 * covariance
