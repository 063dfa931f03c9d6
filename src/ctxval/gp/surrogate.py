"""The Gaussian process over task parameters, fitted to distances in their own units."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows
from ctxval._util.boxes import farthest_rows
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError
from ctxval.gp.hyperposterior import Warp
from ctxval.gp.kernels import Matern
from ctxval.gp.regression import NOISE, GaussianProcess, LogDensity, Mean, condition, fit, zero_mean

_KERNEL = Matern(1.5, ard=True, length_scale=(0.02, 100.0), linear=(1e-4, 50.0))  # of SurrogateHyperparameters


@dataclass(frozen=True, eq=False)
class Surrogate(ShortRepr):
    """A GP of the distance over the unit cube."""

    process: GaussianProcess  # of the standardised distance (d - shift) / scale
    shift: float  # constants of the standardisation, in the distance's units
    scale: float

    def predict(self, points: Array) -> tuple[Array, Array]:
        """Return posterior mean and standard deviation at unit-cube points ``(m, d)``, shapes ``(m,)``."""
        mean, variance = self.process.predict(points)
        return self.shift + self.scale * mean, self.scale * np.sqrt(variance)


def fit_surrogate(
    points: Array,
    values: Array,
    kernel: Matern | None = None,
    *,
    noise: tuple[float, float] = (NOISE, NOISE),
    prior_mean: Mean | None = None,
) -> Surrogate:
    """Return the GP with the most likely hyperparameters, given values ``(n,)`` at unit-cube points ``(n, d)``.

    Pending and failed points have the value NaN. They are assigned the value that the others predict, which lowers the
    uncertainty around them and leaves the mean unchanged. The kernel is Matern 3/2 with one length-scale by default,
    the prior mean the average of the values. The noise has bounds relative to the variance of the values.
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
    mean = zero_mean if prior_mean is None else functools.partial(_scaled, prior_mean, scale)
    process = fit(Matern(1.5) if kernel is None else kernel, X, (y - shift) / scale, noise=noise, mean=mean)
    return Surrogate(_with_imputed(process, points[~known]), shift, scale)


def _scaled(mean: Mean, scale: float, X: Array) -> Array:
    return np.asarray(mean(X), dtype=np.float64) / scale


def _scale(residual: Array) -> float:
    size = float(np.sqrt((residual**2).mean()))
    return size if size > 1e-12 else 1.0


def _with_imputed(process: GaussianProcess, points: Array) -> GaussianProcess:
    if not len(points):
        return process
    X, y = np.concatenate([process.X, points]), np.concatenate([process.y, process.predict(points)[0]])
    return condition(process.kernel, process.theta, X, y, noise=process.noise, mean=process.mean)


# For searches in many dimensions


@dataclass(frozen=True, eq=False)
class SurrogateHyperparameters(ShortRepr):
    """Learned hyperparameters, with which a process can be conditioned on the same values and on later ones."""

    theta: Array  # logarithms of the hyperparameters of a Matern 3/2 kernel and a linear kernel
    warp: Warp  # the scale on which the values are a Gaussian process
    shift: float  # constants of the standardisation on that scale
    scale: float

    def standardised(self, values: Array) -> Array:
        """Return values ``(n,)`` in the process's units."""
        return np.asarray((self.warp.forward(values) - self.shift) / self.scale)

    def condition(self, points: Array, values: Array) -> GaussianProcess:
        """Return the process given values at points ``(n, d)``; NaN becomes the value that the others predict."""
        known = np.isfinite(values)
        process = condition(_KERNEL, self.theta, points[known], self.standardised(values[known]))
        return _with_imputed(process, points[~known])


def learn(points: Array, values: Array) -> SurrogateHyperparameters:
    """Return the most likely hyperparameters given known values ``(n,)`` at unit-cube points ``(n, d)``.

    Length-scales have a log-normal prior whose median grows with the root of the dimension (Hvarfner, Hellsten and
    Nardi 2024). The process models the logarithms of the values if no value is negative and if that predicts each
    value clearly better from all others; else it models the values.
    """
    rows = spread_rows(values, 300)
    points, values = points[rows], values[rows]
    score, learned = _learn_on(points, values, Warp())
    if values.min() >= 0 and values.max() > 0:
        log_score, of_logarithm = _learn_on(points, values, Warp(0.1 * float(values.mean())))
        if log_score > score + 0.25 * len(values):
            return of_logarithm
    return learned


def _learn_on(points: Array, values: Array, warp: Warp) -> tuple[float, SurrogateHyperparameters]:
    """Return the summed log density of each value given all others, on one scale, and the learned hyperparameters."""
    warped, d = warp.forward(values), points.shape[1]
    shift = float(warped.mean())
    scale = _scale(warped - shift)
    y = (warped - shift) / scale
    centre, log_prior = _prior(d)
    rougher = centre + np.array([0.0, *[-1.0] * d, 0.0, 0.0, 0.0])
    process = fit(_KERNEL, points, y, log_prior=log_prior, starts=np.stack([centre, rougher]))
    mean, variance = process.left_out()
    score = -0.5 * (np.log(variance) + (y - mean) ** 2 / variance).sum() - len(y) * np.log(scale)
    return float(score) + warp.log_slope(values), SurrogateHyperparameters(process.theta, warp, shift, scale)


def _prior(d: int) -> tuple[Array, LogDensity]:
    """Return the prior medians of (theta, log noise), and its log density: length-scales share an uncertain mean."""
    # The linear kernel's variances are 0.3, averaged over the cube; the noise is fixed.
    centre = np.log([1.0, *[0.4 * np.sqrt(d)] * d, 0.3, 12 * 0.3 / d, NOISE])

    def log_density(parameters: Array) -> tuple[float, Array]:
        away = parameters - centre
        gradient = -away / 1.5**2
        # Few values suffice to learn the mean of the length-scales' logarithms, many are needed to learn each of them.
        common = away[1 : d + 1].mean()
        gradient[1 : d + 1] = -common / (d * 0.5**2) - (away[1 : d + 1] - common) / 0.3**2
        return 0.5 * float(away @ gradient), gradient  # the density is quadratic

    return np.asarray(centre), log_density


def spread_rows(values: Array, count: int) -> Rows:
    """Return ``count`` rows: half have the largest values, the others are evenly spread over the history."""
    if len(values) <= count:
        return np.arange(len(values))
    order = np.argsort(-values, kind="stable")
    largest, others = order[: count // 2], np.sort(order[count // 2 :])
    evenly = others[np.linspace(0, len(others) - 1, count // 2).astype(int)]
    return np.sort(np.concatenate([largest, evenly]))


def kept_rows(points: Array, values: Array, count: int, long: int = 1000) -> Rows:
    """Return the rows that represent a history of points ``(n, d)`` and values ``(n,)``, in their order.

    Below ``long`` points these are all rows. From then on, a quarter of ``count`` rows have the largest values, a
    quarter are the latest, including pending and failed ones, and the others are far from those and from each other.
    So the surrogate keeps its knowledge of all regions that the history has explored.
    """
    if len(values) < long:
        return np.arange(len(values))
    largest = np.argsort(-np.nan_to_num(values, nan=-np.inf), kind="stable")[: count // 4]
    latest = np.arange(len(values) - count // 4, len(values))
    chosen = np.unique(np.concatenate([largest, latest]))
    gaps = scipy.spatial.distance.cdist(points, points[chosen], "sqeuclidean").min(axis=1)
    gaps[chosen] = -np.inf
    others = farthest_rows(points, gaps, count - len(chosen), squared=True)
    return np.sort(np.concatenate([chosen, np.array(others, dtype=np.intp)]))
