"""The covariance of residual dynamics: a Matern part, which may grow with the inputs, a constant and a linear part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval.gp.kernels import Bounds, Linear, Matern, Towards

_LINEAR = Linear(centre=0.0, variance=(1e-4, 1e6))


@dataclass(frozen=True)
class ResidualKernel:
    """``k(z, w) = matern(z, w) (1 + growth u.u') + constant + slope z.w`` for standardised pairs z = (x, u).

    theta = log of (length-scales, one for each column; constant; slope). The Matern part has unit variance. If M has
    the wrong gain from the input to the states, then the residual grows with the input; a stationary covariance would
    return to its mean outside the data.

    Attributes:
        nu: smoothness of the Matern part, 1.5, 2.5 or 4.5.
        growth: factor of the product of the inputs; 0 for a stationary Matern part.
        inputs: the number m of inputs of the system, which are the last columns.
    """

    nu: float
    growth: float
    inputs: int

    def bounds(self, dimension: int) -> Bounds:
        """Return the bounds of theta; no column is irrelevant beyond 100 standard deviations of the data."""
        scales = (float(np.log(0.05)), float(np.log(100.0)))
        return [*[scales] * dimension, *_LINEAR.bounds(dimension)]

    def __call__(self, theta: Array, X: Array, Z: Array) -> Array:
        """Return the covariances ``(n, m)``."""
        return self.towards(theta, Z)(X)

    def towards(self, theta: Array, Z: Array) -> Towards:
        """Return the covariances with points ``(m, k)`` as a function of other points."""
        matern = Matern(self.nu, ard=True).towards(self._unit(theta), Z)
        linear = _LINEAR.towards(theta[-2:], Z)

        def covariances(X: Array) -> Array:
            found = self._grow(matern(X), X, Z)
            found += linear(X)
            return found

        return covariances

    def diagonal(self, theta: Array, X: Array) -> Array:
        """Return the variances k(z, z), shape ``(n,)``."""
        grown = 1 + self.growth * (self._inputs(X) ** 2).sum(axis=1)
        return np.asarray(grown + _LINEAR.diagonal(theta[-2:], X))

    def weighted_gradient(self, theta: Array, X: Array, W: Array) -> Array:
        """Return ``sum_ij W_ij dK_ij/dtheta`` for K = k(X, X) and a symmetric W, in the shape of theta."""
        grown = self._grow(W.copy(), X, X)
        of_scales = Matern(self.nu, ard=True).weighted_gradient(self._unit(theta), X, grown)[1:]
        return np.concatenate([of_scales, _LINEAR.weighted_gradient(theta[-2:], X, W)])

    def _grow(self, covariances: Array, X: Array, Z: Array) -> Array:
        """Multiply covariances ``(n, m)`` by the growth with the inputs, and return them."""
        if self.growth:
            factors = self._inputs(X) @ self._inputs(Z).T
            factors *= self.growth
            factors += 1
            covariances *= factors
        return covariances

    def _inputs(self, Z: Array) -> Array:
        """Return the columns of the inputs; a system may have none."""
        return Z[:, Z.shape[1] - self.inputs :]

    @staticmethod
    def _unit(theta: Array) -> Array:
        return np.concatenate([[0.0], theta[:-2]])
