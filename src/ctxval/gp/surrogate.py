"""The Gaussian process over task parameters, fitted to distances in their own units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError
from ctxval.gp.hyperposterior import Warp
from ctxval.gp.kernels import Kernel, Linear, Matern, Sum
from ctxval.gp.regression import NOISE, GaussianProcess, Mean, condition, fit, zero_mean

_KERNEL = Sum(Matern(1.5, ard=True, length_scale=(0.02, 100.0)), Linear())
"""The kernel of :class:`Learned`."""
_LENGTH_SCALE = 0.4
"""Prior median of the length-scales, divided by the square root of the dimension."""
_COMMON_DEVIATION = 0.5
"""Prior standard deviation of the mean of the length-scales' logarithms; few values suffice to learn this mean."""
_ARD_DEVIATION = 0.3
"""Prior standard deviation of each logarithm around that mean; it is small, as many values are needed to learn them."""
_VARIANCE = 1.0
"""Prior median of the variance of the Matern kernel."""
_LINEAR = 0.3
"""Prior median of each variance of the linear kernel, averaged over the cube."""
_VARIANCE_DEVIATION = 1.5
"""Prior standard deviation of the logarithms of these variances."""
_OFFSET = 0.1
"""The c of ``log(d + c)``, in means of the values, as in the prior of the certificates."""
_CLEARLY = 0.25
"""Least advantage in log density, per value, for which the logarithms of the values are preferred."""
_LEARNED_FROM = 300
"""Largest number of values from which the hyperparameters are learned."""


@dataclass(frozen=True, eq=False)
class Surrogate(ShortRepr):
    """A GP of the distance over the unit cube.

    Attributes:
        process: the process of the standardised distance ``(d - shift) / scale``.
        shift, scale: constants of the standardisation, in the distance's units.
    """

    process: GaussianProcess
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
    noise: tuple[float, float] = (NOISE, NOISE),
    prior_mean: Mean | None = None,
) -> Surrogate:
    """Return the GP with the most likely hyperparameters, given values ``(n,)`` at unit-cube points ``(n, d)``.

    Pending and failed points have the value NaN. They are assigned the value that the others predict, which lowers the
    uncertainty around them and leaves the mean unchanged.

    Args:
        points: points of the unit cube ``(n, d)``.
        values: values ``(n,)``; NaN if pending or failed.
        kernel: the covariance; Matern 3/2 with one length-scale if None.
        noise: bounds of the noise variance relative to that of the values; equal bounds fix it.
        prior_mean: prior mean of the values as a function of points; their average if None.

    Raises:
        InputError: if fewer than two values are known, or the prior mean is not finite at a known point.
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
    mean = zero_mean if prior_mean is None else _Scaled(prior_mean, scale)
    process = fit(Matern(1.5) if kernel is None else kernel, X, (y - shift) / scale, noise=noise, mean=mean)
    return Surrogate(_with_imputed(process, points[~known]), shift, scale)


def _scale(residual: Array) -> float:
    """Return the residual's root mean square, or 1 if it vanishes."""
    size = float(np.sqrt((residual**2).mean()))
    return size if size > 1e-12 else 1.0


@dataclass(frozen=True)
class _Scaled:
    """A prior mean in units of the standardised values."""

    mean: Mean
    scale: float

    def __call__(self, X: Array) -> Array:
        return np.asarray(self.mean(X), dtype=np.float64) / self.scale


def _with_imputed(process: GaussianProcess, points: Array) -> GaussianProcess:
    if not len(points):
        return process
    imputed, _ = process.predict(points)
    X, y = np.concatenate([process.X, points]), np.concatenate([process.y, imputed])
    return condition(process.kernel, process.theta, X, y, noise=process.noise, mean=process.mean)


# For searches in many dimensions


@dataclass(frozen=True, eq=False)
class Learned(ShortRepr):
    """Learned hyperparameters, with which a process can be conditioned on the same values and on later ones.

    Attributes:
        theta: logarithms of the hyperparameters of a Matern 3/2 kernel, a length-scale for each dimension, and a
            linear kernel.
        warp: the scale on which the values are a Gaussian process.
        shift, scale: constants of the standardisation on that scale.
    """

    theta: Array
    warp: Warp
    shift: float
    scale: float

    def standardised(self, values: Array) -> Array:
        """Return values ``(n,)`` in the process's units."""
        return np.asarray((self.warp.forward(values) - self.shift) / self.scale)

    def condition(self, points: Array, values: Array) -> GaussianProcess:
        """Return the process given values ``(n,)`` at points ``(n, d)``.

        Pending and failed points have the value NaN, and are assigned the value that the others predict.
        """
        known = np.isfinite(values)
        process = condition(_KERNEL, self.theta, points[known], self.standardised(values[known]))
        return _with_imputed(process, points[~known])


def learn(points: Array, values: Array) -> Learned:
    """Return the most likely hyperparameters given known values ``(n,)`` at unit-cube points ``(n, d)``.

    Length-scales have a log-normal prior whose median grows with the root of the dimension (Hvarfner, Hellsten and
    Nardi 2024). The process models the logarithms of the values if no value is negative and if that predicts each
    value clearly better from all others; else it models the values.
    """
    if len(values) > _LEARNED_FROM:
        rows = _informative_rows(values)
        points, values = points[rows], values[rows]
    score, learned = _learn_on(points, values, Warp())
    if values.min() >= 0 and values.max() > 0:
        log_score, of_logarithm = _learn_on(points, values, Warp(_OFFSET * float(values.mean())))
        if log_score > score + _CLEARLY * len(values):
            return of_logarithm
    return learned


def _informative_rows(values: Array) -> Rows:
    """Return the rows of the largest values and of others evenly spread over the history."""
    order = np.argsort(-values, kind="stable")
    largest, others = order[: _LEARNED_FROM // 2], np.sort(order[_LEARNED_FROM // 2 :])
    evenly = others[np.linspace(0, len(others) - 1, _LEARNED_FROM - len(largest)).astype(int)]
    return np.sort(np.concatenate([largest, evenly]))


def _learn_on(points: Array, values: Array, warp: Warp) -> tuple[float, Learned]:
    """Return the summed log density of each value given all others, on one scale, and the learned hyperparameters."""
    warped = warp.forward(values)
    shift = float(warped.mean())
    scale = _scale(warped - shift)
    y = (warped - shift) / scale
    process = fit(_KERNEL, points, y, log_prior=_LogPrior(points.shape[1]), starts=_starts(points.shape[1]))
    mean, variance = process.left_out()
    score = -0.5 * (np.log(variance) + (y - mean) ** 2 / variance).sum() - len(y) * np.log(scale)
    return float(score) + warp.log_slope(values), Learned(process.theta, warp, shift, scale)


def _centre(dimension: int) -> Array:
    """Return the logarithms of the prior medians of theta, and of the noise, which is fixed."""
    scales = [_LENGTH_SCALE * np.sqrt(dimension)] * dimension
    return np.asarray(np.log([_VARIANCE, *scales, _LINEAR, 12 * _LINEAR / dimension, NOISE]))


def _starts(dimension: int) -> Array:
    """Return two starts of the climbs: the prior's mode, and one with shorter length-scales."""
    rougher = np.zeros(dimension + 4)
    rougher[1 : dimension + 1] = -1.0
    return np.asarray(_centre(dimension) + np.array([np.zeros(dimension + 4), rougher]))


@dataclass(frozen=True)
class _LogPrior:
    """Independent normal densities of the hyperparameters' logarithms; length-scales share an uncertain mean.

    Attributes:
        dimension: the dimension of the points.
    """

    dimension: int

    def __call__(self, parameters: Array) -> tuple[float, Array]:
        """Return the log density at (theta, log noise), up to a constant, and its gradient."""
        scales = slice(1, self.dimension + 1)
        away = parameters - _centre(self.dimension)
        gradient = -away / _VARIANCE_DEVIATION**2
        common = away[scales].mean()
        gradient[scales] = (
            -common / (self.dimension * _COMMON_DEVIATION**2) - (away[scales] - common) / _ARD_DEVIATION**2
        )
        return 0.5 * float(away @ gradient), gradient  # the density is quadratic
