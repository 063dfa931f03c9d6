"""Acquisition functions over the unit cube, and how to maximise one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.optimize import minimize

from ctxval.arrays import Array, Mask, Rows
from ctxval.gp import GaussianProcess


class Acquisition(Protocol):
    """How much an execution at a point is worth."""

    def __call__(self, X: Array) -> Array:
        """Return the values at points ``(m, d)`` of the unit cube, shape ``(m,)``."""

    def with_gradient(self, X: Array) -> tuple[Array, Array]:
        """Return the values ``(m,)`` and their gradients ``(m, d)``."""


_DISTINCT = 1e-6


@dataclass(frozen=True, eq=False)
class UpperConfidenceBound:
    """``alpha(p) = mu(p) + beta^(1/2) sigma(p)`` (the paper's eq. 11, GP-UCB).

    Attributes:
        process: the surrogate.
        beta: the confidence parameter; the paper takes 2.
    """

    process: GaussianProcess
    beta: float = 2.0

    def __call__(self, X: Array) -> Array:
        """Return the bound at ``(m, d)``, shape ``(m,)``."""
        mean, variance = self.process.predict(X)
        return np.asarray(mean + np.sqrt(self.beta * variance))

    def with_gradient(self, X: Array) -> tuple[Array, Array]:
        """Return the bound ``(m,)`` and its gradient ``(m, d)``; that of the mean where the variance vanishes."""
        mean, variance, d_mean, d_variance = self.process.predict_with_gradient(X)
        sigma = np.sqrt(variance)[:, None]
        d_sigma = np.divide(d_variance, 2 * sigma, out=np.zeros_like(d_mean), where=sigma > 0)
        value = mean + np.sqrt(self.beta) * sigma[:, 0]
        return np.asarray(value), np.asarray(d_mean + np.sqrt(self.beta) * d_sigma)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """The posterior variance: pure exploration.

    Attributes:
        process: the surrogate.
    """

    process: GaussianProcess

    def __call__(self, X: Array) -> Array:
        """Return the variance at ``(m, d)``, shape ``(m,)``."""
        return self.process.predict(X)[1]

    def with_gradient(self, X: Array) -> tuple[Array, Array]:
        """Return the variance ``(m,)`` and its gradient ``(m, d)``."""
        _, variance, _, d_variance = self.process.predict_with_gradient(X)
        return variance, d_variance


def maximise(acquisition: Acquisition, dimension: int, known: Array, rng: np.random.Generator) -> Array:
    """Return the point ``(d,)`` of the unit cube with the largest acquisition, distinct from all known points.

    Uniform candidates and small moves around the known points; then the best few climb.

    Args:
        acquisition: what to maximise.
        dimension: d.
        known: points never to propose again, shape ``(n, d)``; sorted best first, they seed the local candidates.
        rng: where the candidates come from.
    """
    candidates = rng.random((min(2000, 256 * dimension), dimension))
    nearby = np.repeat(known[:8], 8, axis=0)
    nearby = np.clip(nearby + rng.normal(scale=0.02, size=nearby.shape), 0.0, 1.0)
    candidates = np.concatenate([candidates, nearby])
    order = np.argsort(-acquisition(candidates), kind="stable")
    climbed = _climb(acquisition, candidates[_spread(candidates, order, count=4)])
    finalists = np.concatenate([climbed, candidates[order[:16]]])
    values = np.where(_is_distinct(finalists, known), acquisition(finalists), -np.inf)
    return np.asarray(finalists[np.argmax(values)] if np.isfinite(values).any() else rng.random(dimension))


def _spread(candidates: Array, order: Rows, count: int) -> list[int]:
    """Return the best candidates that are not neighbours of a better one."""
    chosen: list[int] = []
    reach = 0.05 * np.sqrt(candidates.shape[1])
    for i in order[:200].tolist():
        if all(np.linalg.norm(candidates[i] - candidates[j]) > reach for j in chosen):
            chosen.append(i)
        if len(chosen) == count:
            break
    return chosen


def _climb(acquisition: Acquisition, starts: Array) -> Array:
    """Climb from all starts at once: their sum is separable, so one quasi-Newton search serves them all."""

    def negative(flat: Array) -> tuple[float, Array]:
        values, gradients = acquisition.with_gradient(flat.reshape(starts.shape))
        return -float(values.sum()), -gradients.ravel()

    bounds = [(0.0, 1.0)] * starts.size
    result = minimize(negative, starts.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 20})
    return np.asarray(np.clip(result.x, 0.0, 1.0).reshape(starts.shape))


def _is_distinct(points: Array, known: Array) -> Mask:
    if not len(known):
        return np.ones(len(points), dtype=bool)
    gaps = np.abs(points[:, None, :] - known[None, :, :]).max(axis=-1)
    return np.asarray(gaps.min(axis=1) > _DISTINCT)
