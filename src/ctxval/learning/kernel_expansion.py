"""Functions that are weighted sums of covariances, many of them evaluated together."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, product

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.gp.kernels import factorise, tenfold
from ctxval.learning.hyperparameters import Hyperparameters, ResidualKernel


@dataclass(frozen=True, eq=False)
class KernelExpansion:
    """S functions ``f_s(z) = sum_j weights_sj k_s(z, centre_sj)`` with n values each.

    Attributes:
        kernel: the family of the covariances, the same for all functions.
        thetas: logarithms of the hyperparameters of each function, shape ``(S, k + 2)``.
        centres: standardised pairs, shape ``(S, M, k)``.
        weights: shape ``(S, M, n)``.
    """

    kernel: ResidualKernel
    thetas: Array
    centres: Array
    weights: Array

    @classmethod
    def of(cls, hyperparameters: Hyperparameters, centres: Array, weights: Array) -> KernelExpansion:
        """Return functions ``(S, M, n)`` that share hyperparameters and centres ``(M, k)``."""
        S, theta = len(weights), hyperparameters.theta
        shared = np.broadcast_to(theta, (S, *theta.shape)), np.broadcast_to(centres, (S, *centres.shape))
        return cls(hyperparameters.kernel, *shared, weights)

    def __call__(self, z: Array) -> Array:
        """Return the values ``(S, q, n)`` of each function at arguments of its own, ``(S, q, k)``."""
        (S, q, k), M = z.shape, self.centres.shape[1]
        # The squared distance to a centre is linear in an argument, its squared entries and 1.
        extended = np.empty((S, q, 2 * k + 1))
        extended[..., :k] = z
        np.multiply(z, z, out=extended[..., k:-1])
        extended[..., -1] = 1.0
        values = np.matmul(extended, self._linear)
        # As many covariances as stay in the processor's cache are computed together.
        largest = max(1, 20_000 // M)
        together = max(1, largest // max(1, q))
        for s, j in product(range(0, S, together), range(0, q, largest)):
            block, own = (slice(s, s + together), slice(j, j + largest)), slice(s, s + together)
            covariances = self._matern(own, extended[block].swapaxes(1, 2))
            values[block] += np.matmul(covariances.swapaxes(1, 2), self.weights[own])
        return np.asarray(values)

    def __getitem__(self, rows: Rows) -> KernelExpansion:
        """Return some of the functions."""
        return KernelExpansion(self.kernel, self.thetas[rows], self.centres[rows], self.weights[rows])

    @functools.cached_property
    def _linear(self) -> Array:
        """The factors of an extended argument in the linear part, shape ``(S, 2 k + 1, n)``."""
        constant, slope = np.exp(self.thetas[:, -2:]).T[..., None, None]
        slopes = slope * np.matmul(self.centres.swapaxes(1, 2), self.weights)
        constants = constant * self.weights.sum(axis=1, keepdims=True)
        return np.concatenate([slopes, np.zeros_like(slopes), constants], axis=1)

    @functools.cached_property
    def _squared(self) -> Array:
        """The factors of an extended argument in the squares of a Matern function's arguments, ``(S, M, 2 k + 1)``."""
        inverse = 2 * self.kernel.nu / np.exp(2 * self.thetas[:, None, :-2])
        squares = (inverse * self.centres**2).sum(axis=2, keepdims=True)
        shape = self.centres.shape
        factors = [-2 * inverse * self.centres, np.broadcast_to(inverse, shape), squares]
        # In this order, products with few columns are several times as fast.
        return np.concatenate(factors, axis=2).swapaxes(1, 2).copy().swapaxes(1, 2)

    @functools.cached_property
    def _growth(self) -> Array:
        """The same in the growth with the inputs."""
        factors = np.zeros_like(self._squared)
        k, m = self.centres.shape[2], self.kernel.inputs
        factors[..., k - m : k] = self.kernel.growth * self.centres[..., k - m :]
        factors[..., -1] = 1.0
        return factors

    def _matern(self, own: slice, extended: Array) -> Array:
        """Return the Matern part of the covariances ``(s, M, q)`` of some functions, of ``(s, 2 k + 1, q)``."""
        r2 = np.matmul(self._squared[own], extended)
        np.abs(r2, out=r2)  # rounding errors around zero
        r = np.sqrt(r2)
        polynomial = _polynomial(self.kernel.nu, r, r2)
        np.negative(r, out=r)
        decay = np.exp(r, out=r)
        decay *= polynomial
        if self.kernel.growth:
            decay *= np.matmul(self._growth[own], extended)
        return np.asarray(decay)


def joined(expansions: Sequence[KernelExpansion]) -> tuple[KernelExpansion, ...]:
    """Return the same functions, those of one family that follow each other in one expansion."""
    groups = [list(group) for _, group in groupby(expansions, lambda one: one.kernel)]
    return tuple(group[0] if len(group) == 1 else _joined(group) for group in groups)


def _joined(alike: Sequence[KernelExpansion]) -> KernelExpansion:
    most = max(one.centres.shape[1] for one in alike)

    def padded(values: Array) -> Array:
        return np.pad(values, ((0, 0), (0, most - values.shape[1]), (0, 0)))

    return KernelExpansion(
        alike[0].kernel,
        np.concatenate([one.thetas for one in alike]),
        np.concatenate([padded(one.centres) for one in alike]),
        np.concatenate([padded(one.weights) for one in alike]),
    )


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
