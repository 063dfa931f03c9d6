"""The Gaussian process over task parameters, fitted to distances in their own units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval import gp
from ctxval.arrays import Array
from ctxval.errors import InputError
from ctxval.kernels import Kernel, Matern


@dataclass(frozen=True, eq=False)
class Surrogate:
    """A GP of the distance over the unit cube.

    Attributes:
        process: the process of the standardised distance ``(d - shift) / scale``.
        shift, scale: the standardisation.
    """

    process: gp.GaussianProcess
    shift: float
    scale: float

    def predict(self, points: Array) -> tuple[Array, Array]:
        """Return posterior mean and standard deviation at unit-cube points ``(m, d)``, shapes ``(m,)``."""
        mean, variance = self.process.predict(points)
        return self.shift + self.scale * mean, self.scale * np.sqrt(variance)


def fit_surrogate(
    points: Array,
    values: Array,
    kernel: Kernel | None = None,
    *,
    noise: tuple[float, float] = (gp.NOISE, gp.NOISE),
    prior_mean: gp.Mean | None = None,
) -> Surrogate:
    """Return the GP of most likely hyperparameters, given values ``(n,)`` at unit-cube points ``(n, d)``.

    Points whose value is NaN, pending or failed, are taken to have the value that the others predict: that lowers
    the uncertainty around them and moves nothing.

    Raises:
        InputError: fewer than two values are known, or the prior mean is not finite at a known point.
    """
    known = np.isfinite(values)
    if known.sum() < 2:
        raise InputError(f"a surrogate needs at least two known distances, got {int(known.sum())}.")
    X, y = points[known], values[known]
    prior = np.zeros(len(y)) if prior_mean is None else np.asarray(prior_mean(X), dtype=np.float64)
    if prior.shape != y.shape or not np.isfinite(prior).all():
        raise InputError("the prior mean must return one finite value for each point.")
    shift = float(y.mean()) if prior_mean is None else 0.0
    scale = _scale(y - shift - prior)
    mean = gp.zero_mean if prior_mean is None else _Scaled(prior_mean, scale)
    process = gp.fit(Matern(1.5) if kernel is None else kernel, X, (y - shift) / scale, noise=noise, mean=mean)
    return Surrogate(_with_believed(process, points[~known]), shift, scale)


def _scale(residual: Array) -> float:
    """Return the residual's root mean square, or 1 where it vanishes."""
    spread = float(np.sqrt((residual**2).mean()))
    return spread if spread > 1e-12 else 1.0


@dataclass(frozen=True)
class _Scaled:
    mean: gp.Mean
    scale: float

    def __call__(self, X: Array) -> Array:
        return np.asarray(self.mean(X), dtype=np.float64) / self.scale


def _with_believed(process: gp.GaussianProcess, points: Array) -> gp.GaussianProcess:
    if not len(points):
        return process
    believed, _ = process.predict(points)
    X, y = np.concatenate([process.X, points]), np.concatenate([process.y, believed])
    return gp.condition(process.kernel, process.theta, X, y, noise=process.noise, mean=process.mean)
