"""Forecast of the executions until a verdict: how many there are at least or about, and what they would decide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import single_threaded
from ctxval.certificates.maxima import Maxima
from ctxval.certificates.sample import Sample
from ctxval.gp.hyperposterior import Conditioned

HORIZON = 200
"""Largest number of executions in a simulated future."""
_JITTER = 1e-9  # added to variances, relative to the distance's, so that the covariance of near tasks can be factorised


@dataclass(frozen=True)
class Forecast:
    """Forecast of further executions."""

    executions: int | None  #: the fewest that can decide, or the median of simulated futures; None above ``HORIZON``
    validated: float  #: share of the futures, or of the posterior samples of the dynamics, that validate the threshold
    falsified: float  #: share of them in which a distance exceeds the threshold
    fewest: bool = False  #: whether ``executions`` is the fewest that can decide

    def __str__(self) -> str:
        plural = "execution is" if self.executions == 1 else "executions are"
        if self.fewest:
            share = f"{100 * self.validated:.0f} % of the posterior samples of the dynamics stay below the threshold"
            if self.validated < 0.05:
                return f"the learned dynamics expect a distance above the threshold: {share}"
            return f"at least {self.executions} more {plural} needed to validate it; so far, {share}"
        many = f"about {self.executions}" if self.executions is not None else f"more than {HORIZON}"
        shares = {"validated": self.validated, "falsified": self.falsified}
        answer = max(shares, key=lambda name: shares[name])
        outcome = f" ({answer} in {100 * shares[answer]:.0f} % of the simulated futures)" if shares[answer] else ""
        return f"{many} more {plural} expected to decide{outcome}"


def forecast(
    sample: Sample, maxima: Maxima, threshold: float, confidence: float, *, seed: int = 0, futures: int = 32
) -> Forecast:
    """Return how many more executions of GP-UCB decide whether d* is at most the threshold, from draws of d*.

    Each future takes one draw of the hyperparameters, from those that exceed the threshold if there are any. It
    searches a draw of the distance on candidate tasks, until a distance exceeds the threshold or the bound keeps it.
    """
    rng = np.random.default_rng(seed)
    in_the_way = maxima.owners[maxima.draws > threshold]
    owners = in_the_way if len(in_the_way) else maxima.owners
    chosen = [maxima.conditioned[owners[k * len(owners) // futures]] for k in range(futures)]
    with single_threaded():
        ends = [_future(sample, maxima, conditioned, threshold, confidence, rng) for conditioned in chosen]
    lengths, kept = [length for length, _ in ends], sum(validated for _, validated in ends)
    half, decided = float(np.quantile(lengths, 0.5, method="higher")), int(np.isfinite(lengths).sum())
    return Forecast(int(half) if np.isfinite(half) else None, kept / futures, (decided - kept) / futures)


def _future(
    sample: Sample,
    maxima: Maxima,
    conditioned: Conditioned,
    threshold: float,
    confidence: float,
    rng: np.random.Generator,
) -> tuple[float, bool]:
    """Return the number of executions until a future is decided, or infinity, and whether the threshold is kept."""
    highest = maxima.points[:: max(1, len(maxima.points) // 100)]
    candidates = np.concatenate([highest, rng.random((400, sample.points.shape[1]))])
    warp = conditioned.warp  # from here on everything is on the process's scale
    best, limit = float(warp.forward(sample.best)), float(warp.forward(threshold))
    hyperparameters = conditioned.hyperparameters
    k = hyperparameters.kernel(candidates, sample.points)
    weights = conditioned.factor.solve(k.T)
    mean = conditioned.mean + weights.T @ (conditioned.y - conditioned.mean)
    missing = 1 - weights.sum(axis=0)  # the mean of the prior is uncertain, too
    covariance = hyperparameters.kernel(candidates, candidates) - k @ weights
    covariance = conditioned.scale2 * (covariance + conditioned.mean_variance * np.outer(missing, missing))
    L = np.linalg.cholesky(covariance + _JITTER * conditioned.scale2 * np.eye(len(candidates)))
    truth = mean + L @ rng.normal(size=len(candidates))
    tops = (mean[:, None] + L @ rng.normal(size=(len(candidates), 256))).max(axis=0)
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    bound, low, width = max(float(np.quantile(tops, confidence)), best), 0.0, 20.0
    for _ in range(40):  # to the width z at which max (mean + z deviation) is the bound
        middle = 0.5 * (low + width)
        low, width = (middle, width) if float((mean + middle * deviation).max()) < bound else (low, middle)
    # The first bound is that of all draws together: one draw must not decide what all together leave undecided.
    bound = max(float(warp.forward(maxima.upper(confidence))), best)
    for executions in range(HORIZON + 1):
        if best > limit:
            return executions, False
        if bound <= limit:
            return executions, True
        row = int((mean + np.sqrt(2.0) * deviation).argmax())  # GP-UCB with beta = 2
        if deviation[row] <= 1e-6 * max(deviation.max(), 1e-300):
            row = int(deviation.argmax())
        variance = covariance[row, row] + _JITTER * np.trace(covariance) / len(mean) + 1e-300
        pull = covariance[:, row] / variance
        mean = mean + pull * (truth[row] - mean[row])
        covariance = covariance - np.outer(pull, covariance[row])
        deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        best = max(best, float(truth[row]))
        bound = max(float((mean + width * deviation).max()), best)
    return np.inf, False
