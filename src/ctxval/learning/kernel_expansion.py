"""Functions that are weighted sums of covariances with common centres, evaluated quickly for many arguments."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval.gp.cholesky import factorise, tenfold
from ctxval.learning.hyperparameters import Hyperparameters


@dataclass(frozen=True, eq=False)
class KernelExpansion:
    """S functions ``f_s(z) = sum_j weights_sj k(z, centre_j)`` with n values each.

    Attributes:
        centres: standardised pairs, shape ``(M, k)``.
        weights: shape ``(S, M, n)``.
    """

    hyperparameters: Hyperparameters
    centres: Array
    weights: Array

    def __call__(self, z: Array) -> Array:
        """Return the values ``(S, q, n)`` of each function at arguments of its own, ``(S, q, k)``."""
        S, q, k = z.shape
        # The squared distance to a centre is linear in an argument, its squared entries and 1.
        extended = np.empty((S, q, 2 * k + 1))
        extended[..., :k] = z
        np.multiply(z, z, out=extended[..., k:-1])
        extended[..., -1] = 1.0
        values = np.matmul(extended, self._linear)
        # As many covariances as stay in the processor's cache are computed together.
        largest = max(1, 20_000 // len(self.centres))
        together = max(1, largest // max(1, q))
        for s, j in product(range(0, S, together), range(0, q, largest)):
            block = slice(s, s + together), slice(j, j + largest)
            some = extended[block]
            covariances = self._matern(some.reshape(-1, 2 * k + 1)).reshape(*some.shape[:2], -1)
            values[block] += np.matmul(covariances, self.weights[block[0]])
        return np.asarray(values)

    def repeated(self, count: int) -> KernelExpansion:
        """Return the only function of this expansion, ``count`` times."""
        return replace(self, weights=np.repeat(self.weights, count, axis=0))

    def __getitem__(self, rows: slice) -> KernelExpansion:
        """Return some of the functions."""
        return replace(self, weights=self.weights[rows])

    @functools.cached_property
    def _linear(self) -> Array:
        """The factors of an extended argument in the linear part, shape ``(S, 2 k + 1, n)``."""
        constant, slope = np.exp(self.hyperparameters.theta[-2:])
        slopes = slope * np.matmul(self.centres.T, self.weights)
        constants = constant * self.weights.sum(axis=1, keepdims=True)
        return np.concatenate([slopes, np.zeros_like(slopes), constants], axis=1)

    @functools.cached_property
    def _squared(self) -> Array:
        """The factors of an extended argument in the squared arguments of the Matern function, ``(2 k + 1, M)``."""
        inverse = 2 * self.hyperparameters.kernel.nu / np.exp(2 * self.hyperparameters.theta[:-2])
        scaled = -2 * inverse * self.centres
        squares = (inverse * self.centres**2).sum(axis=1)
        return np.stack([*scaled.T, *np.repeat(inverse[:, None], len(self.centres), axis=1), squares])

    @functools.cached_property
    def _growth(self) -> Array:
        """The same in the growth with the inputs."""
        kernel, (M, k) = self.hyperparameters.kernel, self.centres.shape
        factors = np.zeros((2 * k + 1, M))
        factors[k - kernel.inputs : k] = kernel.growth * self.centres[:, k - kernel.inputs :].T
        factors[-1] = 1.0
        return factors

    def _matern(self, extended: Array) -> Array:
        """Return the Matern part of the covariances ``(q, M)`` of extended arguments ``(q, 2 k + 1)``."""
        kernel = self.hyperparameters.kernel
        r2 = extended @ self._squared
        np.abs(r2, out=r2)  # rounding errors around zero
        r = np.sqrt(r2)
        polynomial = _polynomial(kernel.nu, r, r2)
        np.negative(r, out=r)
        decay = np.exp(r, out=r)
        decay *= polynomial
        if kernel.growth:
            decay *= extended @ self._growth
        return np.asarray(decay)


def _polynomial(nu: float, r: Array, r2: Array) -> Array:
    """Return the polynomial of the Matern function of scaled distances and their squares, which are overwritten."""
    if nu == 1.5:
        return np.asarray(np.add(r, 1, out=r2))
    if nu == 2.5:
        r2 *= 1 / 3
        r2 += r
        r2 += 1
        return r2
    polynomial = np.multiply(r, 1 / 105)
    polynomial += 2 / 21
    polynomial *= r
    polynomial += 3 / 7
    r2 *= polynomial
    r2 += r
    r2 += 1
    return r2


def weights_without(covariance: Array, noise: float, outputs: Array, gone: Mask) -> Array:
    """Return the weights ``(k, M, n)`` of k processes, each without the data that are gone for it, ``(k, M)``.

    Leaving out a block of data changes the weights of the others by a linear map, as leaving out one observation does
    (Rasmussen and Williams 2006, Sec. 5.4.2). Weights that rounding errors have spoilt are computed directly.
    """
    factor = factorise(covariance, tenfold(noise))
    added = float((factor.L[-1] ** 2).sum() - covariance[-1, -1])
    inverse, known = factor.inverse(), factor.solve(outputs)
    found = np.repeat(known[None], len(gone), axis=0)
    for own, without in zip(found, gone, strict=True):
        rows, kept = np.flatnonzero(without), np.flatnonzero(~without)
        own -= inverse[:, rows] @ np.linalg.solve(inverse[np.ix_(rows, rows)], known[rows])
        own[rows] = 0.0
        misfit = covariance[kept] @ own + added * own[kept] - outputs[kept]
        if not np.abs(misfit).max(initial=0.0) < 1e-6:
            own[kept] = factorise(covariance[np.ix_(kept, kept)], tenfold(noise)).solve(outputs[kept])
    return found
