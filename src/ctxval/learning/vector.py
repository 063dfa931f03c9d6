"""Predictions of values that are composed of a short vector, such as a norm of the error of the final state.

A norm has kinks and folds where the vector has none, and each evaluation shows the whole vector. So the vector is
modelled as a Gaussian process whose entries share a covariance, and values are composed of predicted vectors.
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
"""Variance relative to the vectors' mean square: it keeps the Cholesky factor safe."""
_START = (0.1, 0.5, 0.1, 1.0)
"""Prior medians of the Matern variance, of the length-scale over the root of the dimension, and of the constant and the
slope variance of the linear kernel; the search for the most likely hyperparameters starts there."""
_LENGTH_SCALE_DEVIATION = 1.0
"""Prior standard deviation of a length-scale's logarithm."""
_VARIANCE_DEVIATION = 3.0
"""Prior standard deviation of a variance's logarithm."""
_LEARNED_FROM = 200
"""The most vectors, the last ones, that the hyperparameters are learned from."""
_BUDGET = 6000
"""Points that may be asked about for one suggestion: no controller is designed for them."""
_DRAWS = 32
"""Draws of the vector from which the doubt is computed."""


@dataclass(frozen=True, eq=False)
class _ComposedPosterior:
    """The posterior of the vectors, and what is composed of it.

    Attributes:
        vectors: the posterior of the vectors over ``scale``.
        scale: their root mean square.
        compose: vectors to values.
    """

    vectors: MultiOutputProcess
    scale: float
    compose: Compose

    def expected(self, points: Array) -> tuple[Array, Array]:
        """Return the values composed of the expected vectors ``(m,)``, and how much draws of them vary, relatively."""
        with single_threaded():
            mean, variance = self.vectors.predict(points)
        expected = np.asarray(self.compose(self.scale * mean))
        # The same draws for all points and always, so that this is a plain function.
        draws = np.random.default_rng(0).normal(size=(_DRAWS, 1, mean.shape[1]))
        drawn = self.compose(self.scale * (mean + np.sqrt(variance)[:, None] * draws))
        deviation = np.sqrt(((drawn - expected) ** 2).mean(axis=0))
        return expected, deviation / np.maximum(np.abs(expected), 1e-12 * self.scale)

    def left_out(self, rows: Rows) -> Array:
        """Return the values composed of the vectors that all others predict, ``(len(rows),)``."""
        return np.asarray(self.compose(self.scale * self.vectors.left_out()[rows]))


def predict_composed(points: Array, vectors: Array, compose: Compose) -> Prediction | None:
    """Return a prediction of values from the vectors of which they are composed at known points.

    Returns None if fewer than two vectors are known, or if all of them are zero.

    Args:
        points: of the unit cube, ``(n, d)``.
        vectors: there, ``(n, k)``.
        compose: vectors ``(..., k)`` -> values ``(...)``.

    Raises:
        ShapeError: points and vectors do not fit together.
    """
    if points.ndim != 2 or vectors.ndim != 2 or len(points) != len(vectors):
        raise ShapeError(f"points (n, d) and vectors (n, k) must fit together, got {points.shape}, {vectors.shape}.")
    scale = float(np.sqrt((vectors**2).mean())) if len(vectors) else 0.0
    if len(vectors) < 2 or scale == 0:
        return None
    with single_threaded():
        theta = _most_likely(points[-_LEARNED_FROM:], vectors[-_LEARNED_FROM:] / scale)
    known = _ComposedPosterior(MultiOutputProcess(_KERNEL, theta, points, vectors / scale, _noises()), scale, compose)
    return Prediction(known.expected, known.left_out, _BUDGET)


def _noises() -> tuple[float, ...]:
    """Return noise variances to be tried in this order: points may be too much alike for the first."""
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
