"""The posterior of the residual dynamics for one draw of the hyperparameters: its mean, and functions drawn from it.

All of these are weighted sums of covariances, and many of them are evaluated together.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.gp.cholesky import CholeskyFactor, factorise, pivoted_cholesky, tenfold
from ctxval.learning.hyperparameters import ResidualHyperparameters, ResidualKernel


@dataclass(frozen=True, eq=False)
class KernelExpansion:
    """S functions ``f_s(z) = sum_j weights_sj k_s(z, centre_sj)`` with n values each."""

    kernel: ResidualKernel  # the family of the covariances, the same for all functions
    thetas: Array  # logarithms of the hyperparameters of each function, (S, k + 2)
    centres: Array  # standardised pairs, (S, M, k)
    weights: Array  # shape (S, M, n)

    @classmethod
    def of(cls, hyperparameters: ResidualHyperparameters, centres: Array, weights: Array) -> KernelExpansion:
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
            block, some = (slice(s, s + together), slice(j, j + largest)), slice(s, s + together)
            covariances = self._matern(some, extended[block].swapaxes(1, 2))
            values[block] += np.matmul(covariances.swapaxes(1, 2), self.weights[some])
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

    def _matern(self, some: slice, extended: Array) -> Array:
        """Return the Matern part of the covariances ``(s, M, q)`` of some functions, of ``(s, 2 k + 1, q)``."""
        r2 = np.matmul(self._squared[some], extended)
        np.abs(r2, out=r2)  # rounding errors around zero
        r = np.sqrt(r2)
        polynomial = _polynomial(self.kernel.nu, r, r2)
        np.negative(r, out=r)
        decay = np.exp(r, out=r)
        decay *= polynomial
        if self.kernel.growth:
            decay *= np.matmul(self._growth[some], extended)
        return np.asarray(decay)


def joined(expansions: Sequence[KernelExpansion]) -> tuple[KernelExpansion, ...]:
    """Return the same functions, those of one family that follow each other in one expansion."""
    groups = [list(group) for _, group in groupby(expansions, lambda expansion: expansion.kernel)]
    return tuple(group[0] if len(group) == 1 else _joined(group) for group in groups)


def _joined(alike: Sequence[KernelExpansion]) -> KernelExpansion:
    most = max(expansion.centres.shape[1] for expansion in alike)

    def padded(values: Array) -> Array:
        return np.pad(values, ((0, 0), (0, most - values.shape[1]), (0, 0)))

    return KernelExpansion(
        alike[0].kernel,
        np.concatenate([expansion.thetas for expansion in alike]),
        np.concatenate([padded(expansion.centres) for expansion in alike]),
        np.concatenate([padded(expansion.weights) for expansion in alike]),
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
    weights = np.repeat(known[None], len(gone), axis=0)
    for remaining, without in zip(weights, gone, strict=True):
        rows, kept = np.flatnonzero(without), np.flatnonzero(~without)
        remaining -= inverse[:, rows] @ np.linalg.solve(inverse[np.ix_(rows, rows)], known[rows])
        remaining[rows] = 0.0
        misfit = covariance[kept] @ remaining + added * remaining[kept] - outputs[kept]
        if not np.abs(misfit).max(initial=0.0) < 1e-6:
            remaining[kept] = factorise(covariance[np.ix_(kept, kept)], tenfold(noise)).solve(outputs[kept])
    return weights


@dataclass(frozen=True, eq=False)
class Component:
    """The posterior of r for one draw of the hyperparameters."""

    hyperparameters: ResidualHyperparameters
    centres: Array  # standardised pairs that it is conditioned on, (M, k)
    factor: CholeskyFactor  # Cholesky factor of their covariance with noise
    weights: Array  # weights of the mean, (M, n)
    squares: Array  # squared size of each state's residuals, relative to the covariance, (n,)
    amplitudes: Array  # standard deviations of the states' residuals, relative to the covariance, (n,)

    @classmethod
    def conditioned(
        cls, hyperparameters: ResidualHyperparameters, Z: Array, Y: Array, rng: np.random.Generator
    ) -> Component:
        """Return the process conditioned on pairs ``(M, k)``, with amplitudes drawn from their posterior."""
        kernel, theta = hyperparameters.kernel, hyperparameters.theta
        factor = factorise(kernel(theta, Z, Z), tenfold(hyperparameters.noise))
        weights = factor.solve(Y)
        squares = (Y * weights).sum(axis=0)
        return cls(hyperparameters, Z, factor, weights, squares, _amplitudes(squares, len(Z), rng))

    def again(self, rng: np.random.Generator) -> Component:
        """Return the same process with other amplitudes."""
        return replace(self, amplitudes=_amplitudes(self.squares, len(self.centres), rng))

    @property
    def mean(self) -> KernelExpansion:
        """The posterior mean, as one function."""
        return KernelExpansion.of(self.hyperparameters, self.centres, self.weights[None])

    @property
    def noise(self) -> Array:
        """The standard deviation of the noise of each standardised residual, shape ``(n,)``."""
        return np.asarray(np.sqrt(self.hyperparameters.noise) * self.amplitudes)

    def variance(self, Z: Array) -> Array:
        """Return the posterior variance at pairs ``(N, k)``, relative to the amplitudes, shape ``(N,)``."""
        return self._whitened(Z)[1]

    def _whitened(self, Z: Array) -> tuple[Array, Array]:
        kernel, theta = self.hyperparameters.kernel, self.hyperparameters.theta
        # For many pairs, a product with the inverse factor is several times as fast as substitution.
        half = self.factor.whiten_many(kernel(theta, Z, self.centres).T)
        return half, np.maximum(kernel.diagonal(theta, Z) - (half**2).sum(axis=0), 0.0)

    def pivots(self, relevant: Array, count: int) -> tuple[Rows, Array, float]:
        """Return rows by pivoted Cholesky of the posterior covariance, its factor, and the share of variance left."""
        kernel, theta = self.hyperparameters.kernel, self.hyperparameters.theta
        half, left = self._whitened(relevant)
        first = left.max(initial=0.0)
        # Variances below the noise are drawn too: many noisy transitions determine a function better than one does.
        rounding = 1e-13 * kernel.diagonal(theta, relevant).max(initial=0.0)
        towards, few = kernel.towards(theta, relevant), len(relevant) <= 300
        covariance = towards(relevant) - half.T @ half if few else None  # cheaper than one row after the other

        def covariances(row: int) -> Array:
            if covariance is not None:
                return np.asarray(covariance[row])
            return np.asarray(towards(relevant[row : row + 1])[0] - half[:, row] @ half)

        chosen = pivoted_cholesky(left, covariances, count, least=max(1e-6 * first, rounding))
        left_out = chosen.left.max() / first if first > rounding else 0.0
        return chosen.rows, chosen.L, float(left_out)


def _amplitudes(squares: Array, count: int, rng: np.random.Generator) -> Array:
    """Return a draw of the amplitudes from their posterior, given ``count`` transitions."""
    return np.asarray(np.sqrt(squares / rng.chisquare(count, len(squares))))


def draw_functions(
    alike: Sequence[Component], relevant: Array, count: int, pivots: int, rng: np.random.Generator
) -> tuple[KernelExpansion, float]:
    """Return ``count`` draws of each of some components, and the share of the variance that they leave out elsewhere.

    Args:
        alike: components that differ in their amplitudes only.
        relevant: pairs ``(R, k)`` that closed loops visit; the pivots, at which draws are exact, are chosen from them.
        pivots: largest number of pivots.
    """
    first = alike[0]
    chosen, L, left_out = first.pivots(relevant, pivots)
    if not len(chosen):
        weights = np.repeat(first.weights[None], count * len(alike), axis=0)
        return KernelExpansion.of(first.hyperparameters, first.centres, weights), left_out
    kernel, theta = first.hyperparameters.kernel, first.hyperparameters.theta
    shape = (count, len(chosen), first.weights.shape[1])
    normal = np.concatenate([rng.standard_normal(shape) * component.amplitudes for component in alike])
    # The values L xi at the pivots are interpolated by the posterior covariance L L', with weights L'^-1 xi.
    weights = np.linalg.solve(L.T, normal)
    cross = first.factor.solve(kernel(theta, first.centres, relevant[chosen]))
    together = np.concatenate([first.weights - np.matmul(cross, weights), weights], axis=1)
    centres = np.concatenate([first.centres, relevant[chosen]])
    return KernelExpansion.of(first.hyperparameters, centres, together), left_out
