"""Sums of kernels around centres, with their derivatives (Rasmussen and Williams 2006, chapter 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array
from ctxval.models.smooth_maps import PullBack, SmoothMap


@dataclass(frozen=True, eq=False)
class Slope:
    """A term ``factor (x_j - pull z_j) weight_j`` of the derivative of k(z, x) by z_j.

    Attributes:
        factor: shape ``(N, M)``, or a number.
        pull: 1 if the kernel depends on x - z, and 0 if it depends on x'z.
        weight: a number, or shape ``(k,)``.
    """

    factor: Array | float
    pull: float
    weight: Array | float

    def times(self, other: Array | float) -> Slope:
        """Return this term multiplied by ``(N, M)`` numbers."""
        return Slope(self.factor * other, self.pull, self.weight)


Slopes = Callable[[], list[Slope]]
Kernel = Callable[[Array, Array], tuple[Array | float, Slopes]]
"""Maps points ``(N, k)`` and centres ``(M, k)`` to ``k(z, x)``, ``(N, M)`` or a number, and the terms of its slope."""


@dataclass(frozen=True, eq=False)
class KernelSum(SmoothMap):
    """The map ``sum_i k(z, x_i) w_i``.

    Attributes:
        centres: the x_i, shape ``(M, k)``.
        weights: the w_i, shape ``(M, o)``.
    """

    kernel: Kernel
    centres: Array
    weights: Array

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values, and what pulls derivatives back to the rows."""
        covariances, slopes = self.kernel(Z, self.centres)
        values = self._matrix(covariances, Z) @ self.weights
        return values, lambda G: np.asarray(G @ self._derivatives(Z, slopes()))

    def _derivatives(self, Z: Array, slopes: list[Slope]) -> Array:
        """Return the derivatives ``(N, o, k)``: sums over the centres of ``factor w`` and of ``factor w x``."""
        (count, k), outputs = Z.shape, self.weights.shape[1]
        moments = (self.weights[:, :, None] * self.centres[:, None, :]).reshape(len(self.centres), -1)
        columns = np.concatenate([self.weights, moments], axis=1)
        derivatives = np.zeros((count, outputs, k))
        for slope in slopes:
            sums = self._matrix(slope.factor, Z) @ columns
            drawn = sums[:, outputs:].reshape(count, outputs, k)
            derivatives += (drawn - slope.pull * sums[:, :outputs, None] * Z[:, None, :]) * slope.weight
        return derivatives

    def _matrix(self, values: Array | float, Z: Array) -> Array:
        return np.broadcast_to(values, (len(Z), len(self.centres)))


# Kernels


def constant(value: float) -> Kernel:
    """Return the kernel that is the same everywhere."""
    return lambda Z, X: (value, list)


def squared_exponential(length_scale: Array | float) -> Kernel:
    """Return ``exp(-d^2 / 2)``, with d the distance in length-scales."""

    def kernel(Z: Array, X: Array) -> tuple[Array, Slopes]:
        K = np.exp(-0.5 * cdist(Z / length_scale, X / length_scale, "sqeuclidean"))
        return K, lambda: [Slope(K, 1.0, np.asarray(length_scale) ** -2.0)]

    return kernel


def matern(length_scale: Array | float, nu: float) -> Kernel | None:
    """Return the Matern kernel of smoothness 1/2, 3/2, 5/2 or infinity; None for any other one."""
    if nu == np.inf:
        return squared_exponential(length_scale)
    if nu not in (0.5, 1.5, 2.5):
        return None

    def kernel(Z: Array, X: Array) -> tuple[Array, Slopes]:
        r = np.sqrt(2 * nu) * cdist(Z / length_scale, X / length_scale)
        decay = np.exp(-r)
        polynomial = {0.5: 1.0, 1.5: 1 + r, 2.5: 1 + r + r**2 / 3}[nu]

        def slopes() -> list[Slope]:
            # At a centre, the kernel of smoothness 1/2 has a kink and no derivative.
            pole = np.divide(decay, r, out=np.zeros_like(r), where=r > 0) if nu == 0.5 else 0.0
            factor = {0.5: pole, 1.5: 3 * decay, 2.5: 5 / 3 * (1 + r) * decay}[nu]
            return [Slope(factor, 1.0, np.asarray(length_scale) ** -2.0)]

        return polynomial * decay, slopes

    return kernel


def rational_quadratic(length_scale: float, alpha: float) -> Kernel:
    """Return ``(1 + d^2 / (2 alpha))^-alpha``, with d the distance in length-scales."""

    def kernel(Z: Array, X: Array) -> tuple[Array, Slopes]:
        base = 1 + cdist(Z / length_scale, X / length_scale, "sqeuclidean") / (2 * alpha)
        return base**-alpha, lambda: [Slope(base ** (-alpha - 1), 1.0, length_scale**-2.0)]

    return kernel


def of_products(function: Callable[[Array], Array], slope: Callable[[Array], Any]) -> Kernel:
    """Return a function of the inner product x'z as a kernel, from the function and its derivative."""

    def kernel(Z: Array, X: Array) -> tuple[Array, Slopes]:
        products = Z @ X.T
        return function(products), lambda: [Slope(slope(products), 0.0, 1.0)]

    return kernel


def total(first: Kernel, second: Kernel) -> Kernel:
    """Return the sum of two kernels."""

    def kernel(Z: Array, X: Array) -> tuple[Array | float, Slopes]:
        (one, one_slopes), (two, two_slopes) = first(Z, X), second(Z, X)
        return one + two, lambda: [*one_slopes(), *two_slopes()]

    return kernel


def product(first: Kernel, second: Kernel) -> Kernel:
    """Return the product of two kernels."""

    def kernel(Z: Array, X: Array) -> tuple[Array | float, Slopes]:
        (one, one_slopes), (two, two_slopes) = first(Z, X), second(Z, X)

        def slopes() -> list[Slope]:
            return [*(slope.times(two) for slope in one_slopes()), *(slope.times(one) for slope in two_slopes())]

        return one * two, slopes

    return kernel


def power(base: Kernel, exponent: float) -> Kernel:
    """Return a power of a kernel."""

    def kernel(Z: Array, X: Array) -> tuple[Array | float, Slopes]:
        K, base_slopes = base(Z, X)
        return K**exponent, lambda: [slope.times(exponent * K ** (exponent - 1)) for slope in base_slopes()]

    return kernel
