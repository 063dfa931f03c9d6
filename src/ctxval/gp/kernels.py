"""Covariance functions with analytic gradients (Rasmussen and Williams 2006, ch. 4 and 5).

A kernel has no state: its hyperparameters are passed as one vector theta of natural logarithms, so every real theta is
valid. ``X`` and ``Z`` are points, shapes ``(n, d)`` and ``(m, d)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy

from ctxval._util.arrays import Array
from ctxval.errors import InputError

_CENTRE = 0.5  # of the unit cube, in each dimension: about which the linear part varies
Bounds = list[tuple[float, float]]
Towards = Callable[[Array], Array]  # points (n, d) -> their covariances (n, m) with points that are fixed


class Covariance(Protocol):
    """A covariance function k(x, z; theta)."""

    def towards(self, theta: Array, Z: Array) -> Towards:
        """Return the covariances with points ``(m, d)`` as a function, which prepares these points only once."""

    def diagonal(self, theta: Array, X: Array) -> Array:
        """Return the variances k(x, x), shape ``(n,)``."""

    def __call__(self, theta: Array, X: Array, Z: Array) -> Array:
        """Return the covariances ``(n, m)``."""
        return self.towards(theta, Z)(X)


@dataclass(frozen=True)
class Matern(Covariance):
    """Matern kernel of smoothness 3/2, 5/2 or 9/2, and a linear one ``v_0 + v_1 (x - c)'(z - c)`` if it has bounds.

    theta = log of (variance, length-scales), then of v_0 and v_1; c is the middle of the unit cube.

    Raises:
        InputError: if nu is none of these.
    """

    nu: float = 1.5  # the paper's
    ard: bool = False  # whether each dimension has its own length-scale; if not, all share one
    length_scale: tuple[float, float] = (0.03, 10.0)  # bounds of the length-scales in the unit cube
    variance: tuple[float, float] = (0.05, 50.0)  # bounds of the variance, for values of unit variance
    linear: tuple[float, float] | None = None  # bounds of both variances of the linear part; None without one

    def __post_init__(self) -> None:
        if self.nu not in (1.5, 2.5, 4.5):
            raise InputError(f"the smoothness nu of a Matern kernel must be 1.5, 2.5 or 4.5, got {self.nu!r}.")

    def bounds(self, dimension: int) -> Bounds:
        """Return the bounds of each entry of theta, within which the hyperparameters are searched."""
        scales = [self.length_scale] * (dimension if self.ard else 1)
        linear = [] if self.linear is None else [self.linear] * 2
        return [(float(np.log(low)), float(np.log(high))) for low, high in (self.variance, *scales, *linear)]

    def towards(self, theta: Array, Z: Array) -> Towards:
        variance, scales, constant, slope = self._parts(theta)
        scaled, centred = Z / scales, (Z - _CENTRE).T

        def covariances(X: Array) -> Array:
            s = scipy.spatial.distance.cdist(X / scales, scaled)
            s *= np.sqrt(2 * self.nu)
            covariance: Array = np.exp(-s)
            covariance *= self._polynomial(s)
            covariance *= variance
            if self.linear is not None:
                linear = (slope * (X - _CENTRE)) @ centred
                linear += constant
                covariance += linear
            return covariance

        return covariances

    def diagonal(self, theta: Array, X: Array) -> Array:
        variance, _, constant, slope = self._parts(theta)
        return np.asarray(variance + (constant + slope * ((X - _CENTRE) ** 2).sum(axis=1)))

    def weighted_gradient(self, theta: Array, X: Array, W: Array) -> Array:
        """Return ``sum_ij W_ij dK_ij/dtheta`` for K = k(X, X) and a symmetric W, in the shape of theta."""
        variance, scales, constant, slope = self._parts(theta)
        Y = X / scales
        r = scipy.spatial.distance.cdist(Y, Y)
        profile, fall = self.profile_and_slope(r)
        by_variance = variance * np.vdot(W, profile)
        # dk/d log l_j = fall(r) * (y_ij - y_kj)^2; the sum over pairs is a quadratic form, without (n, n, d) storage.
        G = W * fall
        G *= variance
        if self.ard:
            by_scales = 2 * ((G.sum(axis=1)[:, None] * Y**2).sum(axis=0) - (Y * (G @ Y)).sum(axis=0))
        else:
            by_scales = np.array([np.vdot(G, r**2)])
        if self.linear is None:
            return np.concatenate([[by_variance], by_scales])
        V = X - _CENTRE
        return np.concatenate([[by_variance], by_scales, [constant * W.sum(), slope * (V * (W @ V)).sum()]])

    def input_gradient(self, theta: Array, X: Array, Z: Array) -> Array:
        """Return ``dk(x_i, z_j)/dx_i``, shape ``(n, m, d)``."""
        variance, scales, _, slope = self._parts(theta)
        Y, V = X / scales, Z / scales
        fall = variance * self.profile_and_slope(scipy.spatial.distance.cdist(Y, V))[1]
        gradient = -fall[:, :, None] * (Y[:, None, :] - V[None, :, :]) / scales
        return np.asarray(gradient if self.linear is None else gradient + slope * (Z - _CENTRE))

    def diagonal_input_gradient(self, theta: Array, X: Array) -> Array:
        """Return ``dk(x, x)/dx``, shape ``(n, d)``."""
        return np.asarray(2 * self._parts(theta)[3] * (X - _CENTRE))

    def _parts(self, theta: Array) -> tuple[float, Array, float, float]:
        """Return the variance and the length-scales, and the variances of the linear part, 0 if there is none."""
        if self.linear is None:
            return np.exp(theta[0]), np.exp(theta[1:]), 0.0, 0.0
        return np.exp(theta[0]), np.exp(theta[1:-2]), np.exp(theta[-2]), np.exp(theta[-1])

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
