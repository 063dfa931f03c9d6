"""Covariance functions with analytic gradients, and factors of their matrices (Rasmussen and Williams 2006, ch. 4, 5).

A kernel has no state: its hyperparameters are passed as one vector theta of natural logarithms, so every real theta is
valid. ``X`` and ``Z`` are points, shapes ``(n, d)`` and ``(m, d)``.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtrs
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array, Rows
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
    """Matern kernel of smoothness 3/2, 5/2 or 9/2; theta = log of (variance, length-scales).

    Attributes:
        nu: smoothness, 1.5 (the paper's), 2.5 or 4.5.
        ard: whether each dimension has its own length-scale; if not, all share one.
        length_scale: bounds of the length-scales in the unit cube.
        variance: bounds of the variance, for values of unit variance.
    """

    nu: float = 1.5
    ard: bool = False
    length_scale: tuple[float, float] = (0.03, 10.0)
    variance: tuple[float, float] = (0.05, 50.0)

    def __post_init__(self) -> None:
        if self.nu not in (1.5, 2.5, 4.5):
            raise InputError(f"the smoothness nu of a Matern kernel must be 1.5, 2.5 or 4.5, got {self.nu!r}.")

    def bounds(self, dimension: int) -> Bounds:
        low, high = np.log(self.length_scale).tolist()
        scales = [(low, high)] * (dimension if self.ard else 1)
        return [(float(np.log(self.variance[0])), float(np.log(self.variance[1]))), *scales]

    def towards(self, theta: Array, Z: Array) -> Towards:
        variance, scales = np.exp(theta[0]), np.exp(theta[1:])
        own = Z / scales

        def covariances(X: Array) -> Array:
            s = cdist(X / scales, own)
            s *= np.sqrt(2 * self.nu)
            found: Array = np.exp(-s)
            found *= self._polynomial(s)
            found *= variance
            return found

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

    def weighted_input_gradient(self, theta: Array, X: Array, Z: Array, weights: Array) -> Array:
        """Return ``sum_j weights_ij dk(x_i, z_j)/dx_i``, shape ``(n, d)``, without the ``(n, m, d)`` of its terms."""
        scales = np.exp(theta[1:])
        pulls = np.exp(theta[0]) * weights * self.profile_and_slope(cdist(X / scales, Z / scales))[1]
        return np.asarray((pulls @ Z - pulls.sum(axis=1)[:, None] * X) / scales**2)

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
    """Linear kernel ``v_0 + v_1 (x - c)'(z - c)``; theta = log of (v_0, v_1).

    Attributes:
        centre: c, the same in each dimension; the default is the middle of the unit cube.
        variance: bounds of both variances, for values of unit variance.
    """

    centre: float = 0.5
    variance: tuple[float, float] = (1e-4, 50.0)

    def bounds(self, dimension: int) -> Bounds:
        low, high = np.log(self.variance).tolist()
        return [(low, high), (low, high)]

    def towards(self, theta: Array, Z: Array) -> Towards:
        constant, slope = np.exp(theta)
        own = (Z - self.centre).T

        def covariances(X: Array) -> Array:
            found = (slope * (X - self.centre)) @ own
            found += constant
            return np.asarray(found)

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
            found = first(X)
            found += second(X)
            return found

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


# Factors. Everything that conditions a Gaussian process on data factorises its covariance matrix here. LAPACK is called
# directly, without the checks of scipy.linalg, which cost more than a small solve.


@dataclass(frozen=True, eq=False)
class CholeskyFactor:
    """The factor L of a positive definite matrix ``K = L L'``; make one with :func:`factorise`."""

    L: Array  # lower triangular, with zeros above its diagonal (n, n)

    def solve(self, right: Array) -> Array:
        """Return ``K^-1 right`` in the shape of ``right``, ``(n,)`` or ``(n, k)``."""
        return np.asarray(dpotrs(self.L, right, lower=1)[0])

    def whiten(self, right: Array) -> Array:
        """Return ``L^-1 right``; if a column of ``right`` has covariance K, that of the result is the identity."""
        return np.asarray(dtrtrs(self.L, right, lower=1)[0])

    def whiten_many(self, right: Array) -> Array:
        """Return ``L^-1 right`` for many columns, by a product with the inverse factor, which is faster.

        The columns of ``right`` are contiguous, and may be overwritten.
        """
        return np.asarray(dtrmm(1.0, self.inverse_factor, right, lower=1, overwrite_b=1))

    def inverse(self) -> Array:
        """Return ``K^-1``, shape ``(n, n)``."""
        lower = dpotri(self.L, lower=1)[0]  # L is zero above its diagonal, and stays so
        inverse = lower + lower.T
        inverse.ravel("K")[:: len(inverse) + 1] *= 0.5  # its diagonal
        return np.asarray(inverse)

    @functools.cached_property
    def inverse_factor(self) -> Array:
        """``L^-1``, shape ``(n, n)``."""
        return self.whiten(np.eye(len(self.L)))

    @functools.cached_property
    def precisions(self) -> Array:
        """The diagonal of ``K^-1``, shape ``(n,)``: inverse variances of each observation given all others."""
        return np.asarray((self.inverse_factor**2).sum(axis=0))

    def precisions_of(self, rows: Rows) -> Array:
        """Return some entries of the diagonal of ``K^-1``, which takes less time than all of them."""
        units = np.zeros((len(self.L), len(rows)), order="F")
        units[rows, np.arange(len(rows))] = 1.0
        return np.asarray((self.whiten(units) ** 2).sum(axis=0))

    def half_log_determinant(self) -> float:
        """Return ``log(det K) / 2``."""
        return float(np.log(np.diag(self.L)).sum())


def factorise(covariance: Array, noises: float | Iterable[float]) -> CholeskyFactor:
    """Return the Cholesky factor of ``covariance + noise I``, shape ``(n, n)``; several noises are tried in turn."""
    tried = [noises] if isinstance(noises, float) else noises
    for noise in tried:
        noisy = np.array(covariance, order="F")
        noisy.ravel("K")[:: len(noisy) + 1] += noise  # its diagonal
        L, info = dpotrf(noisy, lower=1, clean=1, overwrite_a=1)
        if not info and not np.isnan(np.trace(L)):  # some LAPACKs let NaN pass
            return CholeskyFactor(np.asarray(L))
    raise InputError(
        f"the covariance of {len(covariance)} observations is not positive definite; raise the noise variance."
    )


def tenfold(noise: float) -> Iterator[float]:
    """Yield a noise variance, then ten times as much, and so on, up to 1e30 times as much."""
    for _ in range(31):
        yield noise
        noise *= 10


def pivoted_rows(kernel: Covariance, theta: Array, X: Array, count: int, least: float) -> Rows:
    """Return at most ``count`` rows by pivoted Cholesky: each has the largest variance given the rows before it.

    The choice ends if no remaining variance is larger than ``least``.
    """
    towards = kernel.towards(theta, X)
    return pivoted_cholesky(kernel.diagonal(theta, X), lambda row: towards(X[row : row + 1])[0], count, least).rows


@dataclass(frozen=True, eq=False)
class PivotedCholesky:
    """A part of a positive semidefinite matrix of which each row has the largest variance given the rows before it."""

    rows: Rows  # (k,)
    L: Array  # the Cholesky factor of the matrix of these rows (k, k)
    left: Array  # the variances of all n rows given these (n,)


def pivoted_cholesky(
    variances: Array, covariances: Callable[[int], Array], count: int, least: float
) -> PivotedCholesky:
    """Return the Cholesky factor of those rows of a covariance matrix that represent all of it.

    The matrix has the diagonal ``variances`` ``(n,)``, and ``covariances`` returns one of its rows in an array that may
    be overwritten; count and least are as in :func:`pivoted_rows`.
    """
    left = np.array(variances)
    columns = np.empty((min(count, len(left)), len(left)))
    chosen: list[int] = []
    for k, column in enumerate(columns):
        pivot = int(left.argmax())
        if left[pivot] <= least:
            break
        row = covariances(pivot)
        row -= columns[:k, pivot] @ columns[:k]
        np.divide(row, np.sqrt(left[pivot]), out=column)
        left -= np.square(column, out=row)
        left[pivot] = 0.0
        chosen.append(pivot)
    rows = np.array(chosen, dtype=np.intp)
    return PivotedCholesky(rows, np.tril(columns[: len(rows)][:, rows].T), np.maximum(left, 0.0))
