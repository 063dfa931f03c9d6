"""What is expected of values that are composed of a short vector, when the vectors of known points are known too.

A norm has kinks and folds where the vector under it has none, and each evaluation shows the whole vector. So the
vector is the Gaussian process, all its entries with one covariance, and the value is composed on top.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval.errors import ShapeError
from ctxval.gp.kernels import Linear, Matern, Sum
from ctxval.gp.regression import log_likelihood_of_outputs
from ctxval.searches.base import Prediction

Compose = Callable[[Array], Array]
"""Vectors ``(..., k)`` -> values ``(...)``."""

_KERNEL = Sum(Matern(2.5, ard=True, length_scale=(0.05, 100.0), variance=(1e-6, 1e3)), Linear(variance=(1e-6, 1e3)))
_NOISE = 1e-8
"""Variance relative to the vectors' mean square: it keeps the Cholesky factor safe."""
_START = (0.1, 0.5, 0.1, 1.0)
"""Matern variance, length-scale over the root of the dimension, constant and slope variances to start from; the
length-scale is also the median of its log-normal prior, of unit spread."""
_LEARNED_FROM = 200
_BUDGET = 6000
_DRAWS = 32


@dataclass(frozen=True, eq=False)
class _Vectors:
    """The posterior of the vectors.

    Attributes:
        theta: logarithms of the hyperparameters.
        X: known points ``(n, d)``.
        Y: known vectors over ``scale``, ``(n, k)``.
        scale: their root mean square.
        compose: vectors to values.
    """

    theta: Array
    X: Array
    Y: Array
    scale: float
    compose: Compose

    @functools.cached_property
    def _factor(self) -> Array:
        noise = 0.0
        while True:
            try:
                return np.asarray(cho_factor(_covariance(self.theta, self.X, noise), lower=True)[0])
            except LinAlgError:  # points too much alike for so little noise
                noise = max(10 * noise, _NOISE)

    @functools.cached_property
    def _weights(self) -> Array:
        return np.asarray(cho_solve((self._factor, True), self.Y))

    def expected(self, points: Array) -> tuple[Array, Array]:
        """Return the values composed of the expected vectors ``(m,)``, and how much draws of them vary, relatively."""
        with single_threaded():
            k = _KERNEL(self.theta, points, self.X)
            half = solve_triangular(self._factor, k.T, lower=True)
            variance = np.maximum(_KERNEL.diagonal(self.theta, points) - (half**2).sum(axis=0), 0.0)
            mean = k @ self._weights
        expected = np.asarray(self.compose(self.scale * mean))
        # The same draws for all points and always, so that this is a plain function.
        draws = np.random.default_rng(0).normal(size=(_DRAWS, 1, mean.shape[1]))
        drawn = self.compose(self.scale * (mean + np.sqrt(variance)[:, None] * draws))
        spread = np.sqrt(((drawn - expected) ** 2).mean(axis=0))
        return expected, spread / np.maximum(np.abs(expected), 1e-12 * self.scale)

    def left_out(self, rows: Rows) -> Array:
        """Return the values composed of the vectors that all others let one expect (Rasmussen and Williams, 5.12)."""
        inverse = solve_triangular(self._factor, np.eye(len(self.X)), lower=True)
        mean = self.Y - self._weights / (inverse**2).sum(axis=0)[:, None]
        return np.asarray(self.compose(self.scale * mean[rows]))


def predict_composed(points: Array, vectors: Array, compose: Compose) -> Prediction | None:
    """Return what is expected of values, given the vectors that they are composed of at known points.

    None where fewer than two vectors are known, or all are zero.

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
    known = _Vectors(theta, points, vectors / scale, scale, compose)
    return Prediction(known.expected, known.left_out, _BUDGET)


def _covariance(theta: Array, X: Array, more: float = 0.0) -> Array:
    return _KERNEL(theta, X, X) + (_NOISE + more) * np.eye(len(X))


def _most_likely(X: Array, Y: Array) -> Array:
    """Return the hyperparameters that make vectors ``(n, k)``, their entries independent, most likely a posteriori."""
    d = X.shape[1]
    variance, length, constant, slope = np.log(_START)
    start = np.array([variance, *[length + 0.5 * np.log(d)] * d, constant, slope])
    spread = np.array([3.0, *[1.0] * d, 3.0, 3.0])

    def negative(theta: Array) -> tuple[float, Array]:
        away = (theta - start) / spread
        try:
            value, gradient = _log_likelihood(theta, X, Y)
        except LinAlgError:
            return 1e25, np.zeros_like(theta)
        return 0.5 * float(away @ away) - value, away / spread - gradient

    found = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=_KERNEL.bounds(d), options={"maxiter": 60})
    return np.asarray(found.x)


def _log_likelihood(theta: Array, X: Array, Y: Array) -> tuple[float, Array]:
    """Return ``sum_j log p(Y[:, j] | X, theta)``, up to a constant, and its gradient (Rasmussen and Williams, 5.9)."""
    value, W = log_likelihood_of_outputs(_covariance(theta, X), Y)
    return value, _KERNEL.weighted_gradient(theta, X, W)
