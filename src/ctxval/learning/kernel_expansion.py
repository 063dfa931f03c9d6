"""Functions that are weighted sums of covariances with common centres, evaluated quickly for many arguments."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.hyperparameters import Hyperparameters

_CACHED = 20_000
"""Number of covariances that are computed together, so that intermediate results stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class KernelExpansion:
    """S functions ``f_s(z) = sum_j weights_sj k(z, centre_j)`` with n values each.

    Attributes:
        hyperparameters: the covariance k and its hyperparameters.
        centres: standardised pairs, shape ``(M, k)``.
        weights: shape ``(S, M, n)``.
    """

    hyperparameters: Hyperparameters
    centres: Array
    weights: Array

    def __call__(self, z: Array) -> Array:
        """Return the values ``(S, q, n)`` of each function at arguments of its own, ``(S, q, k)``."""
        constants, slopes = self._linear
        values = np.matmul(z, slopes) + constants[:, None, :]
        largest = max(1, _CACHED // len(self.centres))
        for functions, rows in _blocks(z.shape[0], z.shape[1], largest):
            values[functions, rows] += np.matmul(self._matern(z[functions, rows]), self.weights[functions])
        return np.asarray(values)

    def repeated(self, count: int) -> KernelExpansion:
        """Return the only function of this expansion, ``count`` times."""
        return replace(self, weights=np.repeat(self.weights, count, axis=0))

    @functools.cached_property
    def _linear(self) -> tuple[Array, Array]:
        """The constants ``(S, n)`` and the slopes ``(S, k, n)`` of the linear part."""
        constant, slope = np.exp(self.hyperparameters.theta[-2:])
        return constant * self.weights.sum(axis=1), slope * np.matmul(self.centres.T, self.weights)

    @functools.cached_property
    def _scales(self) -> Array:
        """Factors of z in which the argument of the Matern function has unit length."""
        return np.asarray(np.sqrt(2 * self.hyperparameters.kernel.nu) / np.exp(self.hyperparameters.theta[:-2]))

    @functools.cached_property
    def _scaled(self) -> tuple[Array, Array]:
        """``-2 centres'`` and the squared norms of the centres, both scaled."""
        scaled = self.centres * self._scales
        return np.ascontiguousarray(-2 * scaled.T), (scaled**2).sum(axis=1)

    def _matern(self, z: Array) -> Array:
        """Return the Matern part of the covariances ``(..., q, M)`` of arguments ``(..., q, k)``."""
        kernel = self.hyperparameters.kernel
        factors, squares = self._scaled
        own = z * self._scales
        r2 = own @ factors
        r2 += squares
        r2 += (own**2).sum(axis=-1)[..., None]
        np.maximum(r2, 0.0, out=r2)
        r = np.sqrt(r2)
        # The same array holds the squares, the polynomial's quadratic term, and then the decay.
        polynomial = _polynomial(kernel.nu, r, r2)
        decay = np.exp(np.negative(r, out=r), out=r2)
        decay *= polynomial
        if kernel.growth:
            first = z.shape[-1] - kernel.inputs
            growth = z[..., first:] @ (kernel.growth * self.centres[:, first:].T)
            growth += 1
            decay *= growth
        return np.asarray(decay)


def _polynomial(nu: float, r: Array, r2: Array) -> Array:
    """Return the polynomial of the Matern function of scaled distances and their squares, which are overwritten."""
    if nu == 1.5:
        return np.asarray(np.add(r, 1))
    if nu == 2.5:
        r2 *= 1 / 3
        polynomial = np.add(r, r2)
    else:
        polynomial = np.multiply(r, 1 / 105)
        polynomial += 2 / 21
        polynomial *= r
        polynomial += 3 / 7
        polynomial *= r2
        polynomial += r
    polynomial += 1
    return np.asarray(polynomial)


def _blocks(functions: int, arguments: int, largest: int) -> Iterator[tuple[slice, slice]]:
    """Yield blocks of functions and arguments that are evaluated together, no more than ``largest`` arguments."""
    if functions * arguments <= largest:
        yield slice(None), slice(None)
        return
    for one in range(functions):
        for first in range(0, arguments, largest):
            yield slice(one, one + 1), slice(first, first + largest)
