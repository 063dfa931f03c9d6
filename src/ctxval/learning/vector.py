"""Predictions of values that are composed of a short vector, such as a norm of the error of the final state.

A norm has kinks where the vector is smooth, and each evaluation shows the whole vector. So the vector is modelled by
Gaussian processes that share a covariance, one for each entry, and values are composed of predicted vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval.errors import ShapeError
from ctxval.gp.cholesky import tenfold
from ctxval.gp.kernels import Linear, Matern, Sum
from ctxval.gp.regression import MultiOutputProcess, log_likelihood_of_outputs, most_likely
from ctxval.searches.base import Prediction

Compose = Callable[[Array], Array]
"""Vectors ``(..., k)`` -> values ``(...)``."""

_KERNEL = Sum(Matern(2.5, ard=True, length_scale=(0.05, 100.0), variance=(1e-6, 1e3)), Linear(variance=(1e-6, 1e3)))
_NOISE = 1e-8
"""Noise variance relative to the vectors' mean square: it keeps the covariance matrix positive definite."""
_START = (0.1, 0.5, 0.1, 1.0)
"""Prior medians of the Matern variance, of the length-scale over the root of the dimension, and of the constant and the
slope variance of the linear kernel; the search for the most likely hyperparameters starts there."""
_LENGTH_SCALE_DEVIATION = 1.0
"""Prior standard deviation of a length-scale's logarithm."""
_VARIANCE_DEVIATION = 3.0
"""Prior standard deviation of a variance's logarithm."""
_LEARNED_FROM = 200
"""Largest number of vectors, the latest ones, from which the hyperparameters are learned."""
_BUDGET = 6000
"""Number of points that may be predicted for one suggestion; it is large because no controller is designed for them."""
_DRAWS = 32
"""Number of draws of the vector from which the doubt is computed."""


@dataclass(frozen=True, eq=False)
class _ComposedPosterior:
    """The posterior of the vectors, and the values composed of it.

    Attributes:
        vectors: the posterior of the vectors, divided by ``scale``.
        scale: root mean square of the vectors.
        compose: the function from vectors to values.
    """

    vectors: MultiOutputProcess
    scale: float
    compose: Compose

    def expected(self, points: Array) -> tuple[Array, Array]:
        """Return the values composed of the expected vectors ``(m,)``, and the relative deviation of draws ``(m,)``."""
        with single_threaded():
            mean, variance = self.vectors.predict(points)
        expected = np.asarray(self.compose(self.scale * mean))
        # The draws are the same at all points and in all calls, so that the result is a function of the point.
        draws = np.random.default_rng(0).normal(size=(_DRAWS, 1, mean.shape[1]))
        drawn = self.compose(self.scale * (mean + np.sqrt(variance)[:, None] * draws))
        deviation = np.sqrt(((drawn - expected) ** 2).mean(axis=0))
        return expected, deviation / np.maximum(np.abs(expected), 1e-12 * self.scale)

    def left_out(self, rows: Rows) -> Array:
        """Return the values composed of vectors that are predicted from all others, ``(len(rows),)``."""
        return np.asarray(self.compose(self.scale * self.vectors.left_out(rows)))


def predict_composed(points: Array, vectors: Array, compose: Compose) -> Prediction | None:
    """Return a prediction of values from the vectors of which they are composed at known points.

    Returns None if fewer than two vectors are known, or if all of them are zero.

    Args:
        points: known points of the unit cube, ``(n, d)``.
        vectors: the vectors at these points, ``(n, k)``.
        compose: vectors ``(..., k)`` -> values ``(...)``.

    Raises:
        ShapeError: if the shapes of points and vectors do not fit together.
    """
    if points.ndim != 2 or vectors.ndim != 2 or len(points) != len(vectors):
        raise ShapeError(f"points must be (n, d) and vectors (n, k), got {points.shape}, {vectors.shape}.")
    scale = float(np.sqrt((vectors**2).mean())) if len(vectors) else 0.0
    if len(vectors) < 2 or scale == 0:
        return None
    with single_threaded():
        theta = _most_likely(points[-_LEARNED_FROM:], vectors[-_LEARNED_FROM:] / scale)
    known = _ComposedPosterior(MultiOutputProcess(_KERNEL, theta, points, vectors / scale, _noises()), scale, compose)
    return Prediction(known.expected, known.left_out, _BUDGET)


def _noises() -> tuple[float, ...]:
    """Return noise variances in the order in which they are tried: points may be too similar for the first."""
    return (_NOISE, *(_NOISE + more for more in tenfold(_NOISE)))


def _most_likely(X: Array, Y: Array) -> Array:
    """Return the hyperparameters that make vectors ``(n, k)``, their entries independent, most likely a posteriori."""
    d = X.shape[1]
    variance, length, constant, slope = np.log(_START)
    medians = np.array([variance, *[length + 0.5 * np.log(d)] * d, constant, slope])
    deviations = np.array([_VARIANCE_DEVIATION, *[_LENGTH_SCALE_DEVIATION] * d, *[_VARIANCE_DEVIATION] * 2])

    def log_density(theta: Array) -> tuple[float, Array]:
        away = (theta - medians) / deviations
        value, gradient = _log_likelihood(theta, X, Y)
        return value - 0.5 * float(away @ away), gradient - away / deviations

    return most_likely(log_density, medians[None], _KERNEL.bounds(d))


def _log_likelihood(theta: Array, X: Array, Y: Array) -> tuple[float, Array]:
    """Return ``sum_j log p(Y[:, j] | X, theta)``, up to a constant, and its gradient (Rasmussen and Williams, 5.9)."""
    value, W = log_likelihood_of_outputs(_KERNEL(theta, X, X), _NOISE, Y)
    return value, _KERNEL.weighted_gradient(theta, X, W)
