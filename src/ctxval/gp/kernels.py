"""Covariance functions with analytic gradients (Rasmussen and Williams 2006, ch. 4 and 5).

A kernel has no state: its hyperparameters are passed as one vector theta of natural logarithms, so every real theta is
valid. ``X`` and ``Z`` are points, shapes ``(n, d)`` and ``(m, d)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array
from ctxval.errors import InputError

Bounds = list[tuple[float, float]]

Towards = Callable[[Array], Array]
"""Points ``(n, d)`` -> their covariances ``(n, m)`` with points that are fixed."""


class Covariance(Protocol):
    """A covariance function k(x, z; theta)."""

    def towards(self, theta: Array, Z: Array) -> Towards:
        """Return the covariances with points ``(m, d)`` as a function, which prepares these points only once."""

    def diagonal(self, theta: Array, X: Array) -> Array:
        """Return the variances k(x, x), shape ``(n,)``."""

    def __call__(self, theta: Array, X: Array, Z: Array) -> Array:
        """Return the covariances ``(n, m)``."""
        return self.towards(theta, Z)(X)


class Kernel(Covariance, Protocol):
    """A covariance function with bounds of its hyperparameters and with gradients."""

    def bounds(self, dimension: int) -> Bounds:
        """Return the bounds of each entry of theta, within which the hyperparameters are searched."""

    def weighted_gradient(self, theta: Array, X: Array, W: Array) -> Array:
        """Return ``sum_ij W_ij dK_ij/dtheta`` for K = k(X, X) and a symmetric W, in the shape of theta."""

    def input_gradient(self, theta: Array, X: Array, Z: Array) -> Array:
        """Return ``dk(x_i, z_j)/dx_i``, shape ``(n, m, d)``."""

    def diagonal_input_gradient(self, theta: Array, X: Array) -> Array:
        """Return ``dk(x, x)/dx``, shape ``(n, d)``."""


@dataclass(frozen=True)
class Matern(Kernel):
    """Matern kernel of smoothness 3/2, 5/2 or 9/2; theta = log of (variance, length-scales)."""

    nu: float = 1.5  # the paper's
    ard: bool = False  # whether each dimension has its own length-scale; if not, all share one
    length_scale: tuple[float, float] = (0.03, 10.0)  # bounds of the length-scales in the unit cube
    variance: tuple[float, float] = (0.05, 50.0)  # bounds of the variance, for values of unit variance

    def __post_init__(self) -> None:
        if self.nu not in (1.5, 2.5, 4.5):
            raise InputError(f"the smoothness nu of a Matern kernel must be 1.5, 2.5 or 4.5, got {self.nu!r}.")

    def bounds(self, dimension: int) -> Bounds:
        low, high = np.log(self.length_scale).tolist()
        scales = [(low, high)] * (dimension if self.ard else 1)
        return [(float(np.log(self.variance[0])), float(np.log(self.variance[1]))), *scales]

    def towards(self, theta: Array, Z: Array) -> Towards:
        variance, scales = np.exp(theta[0]), np.exp(theta[1:])
        scaled = Z / scales

        def covariances(X: Array) -> Array:
            s = cdist(X / scales, scaled)
            s *= np.sqrt(2 * self.nu)
            covariance: Array = np.exp(-s)
            covariance *= self._polynomial(s)
            covariance *= variance
            return covariance

        return covariances

    def diagonal(self, theta: Array, X: Array) -> Array:
        return np.full(len(X), np.exp(theta[0]))

    def weighted_gradient(self, theta: Array, X: Array, W: Array) -> Array:
        scales = np.exp(theta[1:])
        Y = X / scales
        r = cdist(Y, Y)
        variance = np.exp(theta[0])
        profile, slope = self.profile_and_slope(r)
        by_variance = variance * np.vdot(W, profile)
        # dk/d log l_j = slope(r) * (y_ij - y_kj)^2; the sum over pairs is a quadratic form, without (n, n, d) storage.
        G = W * slope
        G *= variance
        if self.ard:
            by_scales = 2 * ((G.sum(axis=1)[:, None] * Y**2).sum(axis=0) - (Y * (G @ Y)).sum(axis=0))
        else:
            by_scales = np.array([np.vdot(G, r**2)])
        return np.concatenate([[by_variance], by_scales])

    def input_gradient(self, theta: Array, X: Array, Z: Array) -> Array:
        scales = np.exp(theta[1:])
        Y, V = X / scales, Z / scales
        slope = np.exp(theta[0]) * self.profile_and_slope(cdist(Y, V))[1]
        return np.asarray(-slope[:, :, None] * (Y[:, None, :] - V[None, :, :]) / scales)

    def diagonal_input_gradient(self, theta: Array, X: Array) -> Array:
        return np.zeros_like(X)

    def profile_and_slope(self, r: Array) -> tuple[Array, Array]:
        """Return k(r) and ``-k'(r) / r``, which is finite at r = 0, for unit variance and length-scale."""
        s = np.sqrt(2 * self.nu) * r
        decay = np.exp(-s)
        if self.nu == 1.5:
            slope = 3.0 * decay
        elif self.nu == 2.5:
            slope = 5 / 3 * (1 + s) * decay
        else:
            slope = 9 / 7 * (1 + s * (1 + s * (2 / 5 + s / 15))) * decay
        decay *= self._polynomial(s)
        return decay, slope

    def _polynomial(self, s: Array) -> Array:
        """Return the polynomial that multiplies ``exp(-s)``; s is overwritten."""
        if self.nu == 1.5:
            s += 1
            return s
        if self.nu == 4.5:
            return 1 + s * (1 + s * (3 / 7 + s * (2 / 21 + s / 105)))
        squares = s**2
        squares /= 3
        s += 1
        s += squares
        return s


@dataclass(frozen=True)
class Linear(Kernel):
    """Linear kernel ``v_0 + v_1 (x - c)'(z - c)``; theta = log of (v_0, v_1)."""

    centre: float = 0.5  # c, the same in each dimension; the default is the middle of the unit cube
    variance: tuple[float, float] = (1e-4, 50.0)  # bounds of both variances, for values of unit variance

    def bounds(self, dimension: int) -> Bounds:
        low, high = np.log(self.variance).tolist()
        return [(low, high), (low, high)]

    def towards(self, theta: Array, Z: Array) -> Towards:
        constant, slope = np.exp(theta)
        centred = (Z - self.centre).T

        def covariances(X: Array) -> Array:
            covariance = (slope * (X - self.centre)) @ centred
            covariance += constant
            return np.asarray(covariance)

        return covariances

    def diagonal(self, theta: Array, X: Array) -> Array:
        return np.asarray(np.exp(theta[0]) + np.exp(theta[1]) * ((X - self.centre) ** 2).sum(axis=1))

    def weighted_gradient(self, theta: Array, X: Array, W: Array) -> Array:
        Y = X - self.centre
        return np.array([np.exp(theta[0]) * W.sum(), np.exp(theta[1]) * (Y * (W @ Y)).sum()])

    def input_gradient(self, theta: Array, X: Array, Z: Array) -> Array:
        gradient = np.exp(theta[1]) * (Z - self.centre)
        return np.broadcast_to(gradient, (len(X), *Z.shape))

    def diagonal_input_gradient(self, theta: Array, X: Array) -> Array:
        return np.asarray(2 * np.exp(theta[1]) * (X - self.centre))


@dataclass(frozen=True)
class Sum(Kernel):
    """The sum of two kernels; theta is that of the first, then that of the second."""

    first: Kernel
    second: Kernel

    def _split(self, theta: Array, dimension: int) -> tuple[Array, Array]:
        size = len(self.first.bounds(dimension))
        return theta[:size], theta[size:]

    def bounds(self, dimension: int) -> Bounds:
        return [*self.first.bounds(dimension), *self.second.bounds(dimension)]

    def towards(self, theta: Array, Z: Array) -> Towards:
        a, b = self._split(theta, Z.shape[1])
        first, second = self.first.towards(a, Z), self.second.towards(b, Z)

        def covariances(X: Array) -> Array:
            covariance = first(X)
            covariance += second(X)
            return covariance

        return covariances

    def diagonal(self, theta: Array, X: Array) -> Array:
        a, b = self._split(theta, X.shape[1])
        return self.first.diagonal(a, X) + self.second.diagonal(b, X)

    def weighted_gradient(self, theta: Array, X: Array, W: Array) -> Array:
        a, b = self._split(theta, X.shape[1])
        return np.concatenate([self.first.weighted_gradient(a, X, W), self.second.weighted_gradient(b, X, W)])

    def input_gradient(self, theta: Array, X: Array, Z: Array) -> Array:
        a, b = self._split(theta, X.shape[1])
        return self.first.input_gradient(a, X, Z) + self.second.input_gradient(b, X, Z)

    def diagonal_input_gradient(self, theta: Array, X: Array) -> Array:
        a, b = self._split(theta, X.shape[1])
        return self.first.diagonal_input_gradient(a, X) + self.second.diagonal_input_gradient(b, X)
