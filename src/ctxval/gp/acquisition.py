"""Acquisition functions over the unit cube, and how to maximise one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask
from ctxval._util.boxes import Box, climb, polish, separated_rows
from ctxval.gp.regression import GaussianProcess


class Acquisition(Protocol):
    """A function whose value at a point measures the benefit of an execution there."""

    def __call__(self, X: Array) -> Array:
        """Return the values at points ``(m, d)`` of the unit cube, shape ``(m,)``."""

    def with_gradient(self, X: Array) -> tuple[Array, Array]:
        """Return the values ``(m,)`` and their gradients ``(m, d)``."""


NEAR = 1e-6  # change of each coordinate up to which two points are one
_FAR_BELOW = -1e3  # below this number of standard deviations, a series replaces differences of large logarithms
_CERTAIN = 1e-9  # least standard deviation in the expected improvement; smaller ones are replaced by it
_LOG_ROOT_2PI = 0.5 * float(np.log(2 * np.pi))


@dataclass(frozen=True, eq=False)
class UpperConfidenceBound:
    """``alpha(p) = mu(p) + beta^(1/2) sigma(p)`` (the paper's eq. 10, GP-UCB)."""

    process: GaussianProcess
    beta: float = 2.0  # the confidence parameter; the paper takes 2

    def __call__(self, X: Array) -> Array:
        mean, variance = self.process.predict(X)
        return np.asarray(mean + np.sqrt(self.beta * variance))

    def with_gradient(self, X: Array) -> tuple[Array, Array]:
        """Return the bound ``(m,)`` and its gradient ``(m, d)``; where the variance is zero, the mean's gradient."""
        mean, variance, d_mean, d_variance = self.process.predict_with_gradient(X)
        sigma = np.sqrt(variance)[:, None]
        d_sigma = np.divide(d_variance, 2 * sigma, out=np.zeros_like(d_mean), where=sigma > 0)
        value = mean + np.sqrt(self.beta) * sigma[:, 0]
        return np.asarray(value), np.asarray(d_mean + np.sqrt(self.beta) * d_sigma)


@dataclass(frozen=True, eq=False)
class LogExpectedImprovement:
    """``log E max(f(p) - best, 0)``, also if the expectation underflows (Ament et al. 2023, eqs. 8 and 9)."""

    process: GaussianProcess
    best: float  # the value to improve on, in the process's units

    def __call__(self, X: Array) -> Array:
        mean, variance = self.process.predict(X)
        sigma = np.maximum(np.sqrt(variance), _CERTAIN)
        return np.asarray(log_improvement((mean - self.best) / sigma) + np.log(sigma))

    def with_gradient(self, X: Array) -> tuple[Array, Array]:
        mean, variance, d_mean, d_variance = self.process.predict_with_gradient(X)
        sigma = np.maximum(np.sqrt(variance), _CERTAIN)
        d_sigma = np.where(np.sqrt(variance) > _CERTAIN, d_variance.T / (2 * sigma), 0.0).T
        z = (mean - self.best) / sigma
        # The derivative of log_improvement, Phi(z) / (phi(z) + z Phi(z)).
        near, far = np.maximum(z, _FAR_BELOW), np.minimum(z, _FAR_BELOW)
        slope = np.where(z > _FAR_BELOW, np.exp(scipy.special.log_ndtr(near) - log_improvement(near)), -far - 2 / far)
        gradient = (slope * d_mean.T + (1 - z * slope) * d_sigma.T) / sigma
        return np.asarray(log_improvement(z) + np.log(sigma)), np.asarray(gradient.T)


def log_improvement(z: Array) -> Array:
    """Return ``log(phi(z) + z Phi(z))``, the expected improvement of a standard normal variate over ``-z``."""
    z = np.asarray(z, dtype=np.float64)
    near, middle = np.maximum(z, -1.0), np.clip(z, _FAR_BELOW, -1.0)
    direct = np.log(np.exp(-0.5 * near**2 - _LOG_ROOT_2PI) + near * scipy.special.ndtr(near))
    # phi(z) (1 - |z| Phi(z) / phi(z)); erfcx gives the ratio Phi / phi, whose parts would both underflow.
    ratio = np.sqrt(np.pi / 2) * scipy.special.erfcx(-middle / np.sqrt(2))
    scaled = -0.5 * middle**2 - _LOG_ROOT_2PI + np.log1p(middle * ratio)
    far = np.minimum(z, _FAR_BELOW)
    series = -0.5 * far**2 - _LOG_ROOT_2PI - 2 * np.log(-far) + np.log1p(-3 / far**2)
    return np.asarray(np.where(z > -1, direct, np.where(z > _FAR_BELOW, scaled, series)))


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """The posterior variance: pure exploration."""

    process: GaussianProcess

    def __call__(self, X: Array) -> Array:
        return self.process.predict(X)[1]

    def with_gradient(self, X: Array) -> tuple[Array, Array]:
        return self.process.predict_with_gradient(X)[1::2]


def maximise(
    acquisition: Acquisition,
    dimension: int,
    known: Array,
    rng: np.random.Generator,
    *,
    box: Box | None = None,
    corners: bool = False,
    away: Array | None = None,
    near: float = NEAR,
) -> Array:
    """Return the point ``(d,)`` of a box, or the unit cube, with the largest acquisition, distinct from known points.

    A coordinate of it differs from each known point by more than ``near``, if it does for any candidate. Candidates are
    uniform, or small moves of the known points ``(n, d)``, best first. The function is climbed from the best few of
    them. With corners, these are candidates too, and single coordinates are moved to bounds at last while that
    increases the value. The result keeps a distance from points ``away``, which are pending or have failed.
    """
    diagonal = float(np.sqrt(dimension))
    others = np.empty((0, dimension)) if away is None else away

    def is_apart(points: Array) -> Mask:
        return np.asarray(scipy.spatial.distance.cdist(points, others).min(axis=1, initial=np.inf) > 0.02 * diagonal)

    low, high = (np.zeros(dimension), np.ones(dimension)) if box is None else box
    candidates = low + rng.random((min(2000, 256 * dimension), dimension)) * (high - low)
    nearby = np.repeat(known[:8], 8, axis=0)
    nearby = np.clip(nearby + rng.normal(scale=0.02, size=nearby.shape), low, high)
    if corners:
        second = candidates[::2]
        snapped = rng.random(second.shape) < rng.random((len(second), 1))  # the share is drawn for each point
        second[snapped] = np.where(rng.random(second.shape) < 0.5, low, high)[snapped]
    candidates = np.concatenate([candidates, nearby])
    if (apart := is_apart(candidates)).any():
        candidates = candidates[apart]
    order = np.argsort(-acquisition(candidates), kind="stable")
    best = candidates[order[:200]]
    starts = best[separated_rows(best, 0.05 * diagonal, 4)]
    climbed, _ = climb(acquisition.with_gradient, starts, low, high, iterations=20)
    if corners:
        heights = acquisition(climbed)
        row = [int(heights.argmax())]
        top, _ = polish(lambda Z: acquisition(Z[0])[None], climbed[row], heights[row], (low, high), 2 * dimension)
        climbed = np.concatenate([climbed, top])
    finalists = np.concatenate([climbed, best])
    gaps = scipy.spatial.distance.cdist(finalists, known, "chebyshev").min(axis=1, initial=np.inf)
    for least in (near, NEAR):
        values = np.where((gaps > least) & is_apart(finalists), acquisition(finalists), -np.inf)
        if np.isfinite(values).any():
            return np.asarray(finalists[np.argmax(values)])
    return np.asarray(low + rng.random(dimension) * (high - low))
