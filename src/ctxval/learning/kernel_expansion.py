"""The posterior of the residual dynamics for one draw of the hyperparameters: its mean, and functions drawn from it.

All of these are weighted sums of covariances, and many of them are evaluated together.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.gp.cholesky import CholeskyFactor, factorise, pivoted_cholesky, pivoted_matrix
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
        linear, squared, growth = self._factors
        extended = np.empty((S, q, 2 * k + 1))
        extended[..., :k] = z
        np.multiply(z, z, out=extended[..., k:-1])
        extended[..., -1] = 1.0
        values = np.matmul(extended, linear)
        # As many covariances as stay in the processor's cache are computed together, (s, M, q).
        largest = max(1, 20_000 // M)
        together = max(1, largest // max(1, q))
        for s, j in product(range(0, S, together), range(0, q, largest)):
            some, block = slice(s, s + together), (slice(s, s + together), slice(j, j + largest))
            arguments = extended[block].swapaxes(1, 2)
            r2 = np.matmul(squared[some], arguments)
            np.abs(r2, out=r2)  # rounding errors around zero
            r = np.sqrt(r2)
            polynomial = _polynomial(self.kernel.nu, r, r2)
            np.negative(r, out=r)
            covariances = np.exp(r, out=r)
            covariances *= polynomial
            if growth is not None:
                covariances *= np.matmul(growth[some], arguments)
            values[block] += np.matmul(covariances.swapaxes(1, 2), self.weights[some])
        return np.asarray(values)

    def __getitem__(self, rows: Rows) -> KernelExpansion:
        """Return some of the functions."""
        return KernelExpansion(self.kernel, self.thetas[rows], self.centres[rows], self.weights[rows])

    @functools.cached_property
    def _factors(self) -> tuple[Array, Array, Array | None]:
        """What is linear in an argument, its squared entries and 1, as factors of these 2 k + 1 numbers.

        These are the linear part ``(S, 2 k + 1, n)``, the squares of a Matern function's arguments ``(S, M, 2 k + 1)``,
        and the growth with the inputs in the same shape; None if there is none.
        """
        centres, k, m = self.centres, self.centres.shape[2], self.kernel.inputs
        constant, slope = np.exp(self.thetas[:, -2:]).T[..., None, None]
        slopes = slope * np.matmul(centres.swapaxes(1, 2), self.weights)
        constants = constant * self.weights.sum(axis=1, keepdims=True)
        linear = np.concatenate([slopes, np.zeros_like(slopes), constants], axis=1)
        inverse = 2 * self.kernel.nu / np.exp(2 * self.thetas[:, None, :-2])
        constants = (inverse * centres**2).sum(axis=2, keepdims=True)
        squared = np.concatenate([-2 * inverse * centres, np.broadcast_to(inverse, centres.shape), constants], axis=2)
        # In this order, products with few columns are several times as fast.
        squared = squared.swapaxes(1, 2).copy().swapaxes(1, 2)
        if not self.kernel.growth:
            return linear, squared, None
        growth = np.zeros_like(squared)
        growth[..., k - m : k] = self.kernel.growth * centres[..., k - m :]
        growth[..., -1] = 1.0
        return linear, squared, growth


def joined(expansions: Sequence[KernelExpansion]) -> tuple[KernelExpansion, ...]:
    """Return the same functions, those of one family that follow each other in one expansion."""
    together = list[KernelExpansion]()
    for kernel, group in groupby(expansions, lambda expansion: expansion.kernel):
        alike = list(group)
        most = max(expansion.centres.shape[1] for expansion in alike)
        missing = [((0, 0), (0, most - expansion.centres.shape[1]), (0, 0)) for expansion in alike]
        centres, weights = (
            np.concatenate([np.pad(getattr(each, name), more) for each, more in zip(alike, missing, strict=True)])
            for name in ("centres", "weights")
        )
        together.append(KernelExpansion(kernel, np.concatenate([each.thetas for each in alike]), centres, weights))
    return tuple(together)


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
        factor = factorise(kernel(theta, Z, Z), hyperparameters.noise, insist=True)
        weights = factor.solve(Y)
        squares = (Y * weights).sum(axis=0)
        return cls(hyperparameters, Z, factor, weights, squares, squares).again(rng)

    def again(self, rng: np.random.Generator) -> Component:
        """Return the same process with other amplitudes, drawn from their posterior."""
        chi2 = rng.chisquare(len(self.centres), len(self.squares))
        return replace(self, amplitudes=np.sqrt(self.squares / chi2))

    @property
    def mean(self) -> KernelExpansion:
        """The posterior mean, as one function."""
        return KernelExpansion.of(self.hyperparameters, self.centres, self.weights[None])

    @property
    def noise(self) -> Array:
        """The standard deviation of the noise of each standardised residual, shape ``(n,)``."""
        return np.asarray(np.sqrt(self.hyperparameters.noise) * self.amplitudes)

    def whitened(self, Z: Array) -> tuple[Array, Array]:
        """Return ``L^-1 k(centres, Z)``, shape ``(M, N)``, and the posterior variance ``(N,)`` for unit amplitudes."""
        kernel, theta = self.hyperparameters.kernel, self.hyperparameters.theta
        # For many pairs, a product with the inverse factor is several times as fast as substitution.
        whiten = self.factor.whiten_many if len(Z) > len(self.centres) else self.factor.whiten
        half = whiten(kernel(theta, Z, self.centres).T)
        return half, np.maximum(kernel.diagonal(theta, Z) - (half**2).sum(axis=0), 0.0)


def draw_functions(
    alike: Sequence[Component], relevant: Array, count: int, pivots: int, rng: np.random.Generator
) -> tuple[KernelExpansion, float]:
    """Return ``count`` draws of each of some components, and the share of the variance that they leave out elsewhere.

    The components differ in their amplitudes only. Draws are exact at so many ``pivots`` at most, chosen from relevant
    pairs ``(R, k)``, which closed loops visit.
    """
    first = alike[0]
    kernel, theta = first.hyperparameters.kernel, first.hyperparameters.theta
    half, left = first.whitened(relevant)
    largest = left.max(initial=0.0)
    # Variances below the noise are drawn too: many noisy transitions determine a function better than one does.
    rounding = 1e-13 * kernel.diagonal(theta, relevant).max(initial=0.0)
    towards, least = kernel.towards(theta, relevant), max(1e-6 * largest, rounding)
    if len(relevant) <= 300:  # cheaper than one row after the other
        chosen, L, left = pivoted_matrix(left, towards(relevant) - half.T @ half, pivots, least)
    else:

        def covariances(row: int) -> Array:
            return np.asarray(towards(relevant[row : row + 1])[0] - half[:, row] @ half)

        chosen, L, left = pivoted_cholesky(left, covariances, pivots, least)
    left_out = float(left.max() / largest) if largest > rounding else 0.0
    if not len(chosen):
        weights = np.repeat(first.weights[None], count * len(alike), axis=0)
        return KernelExpansion.of(first.hyperparameters, first.centres, weights), left_out
    at = relevant[chosen]
    shape = (count, len(at), first.weights.shape[1])
    normal = np.concatenate([rng.standard_normal(shape) * component.amplitudes for component in alike])
    # The values L xi at the pivots are interpolated by the posterior covariance L L', with weights L'^-1 xi.
    weights = np.linalg.solve(L.T, normal)
    columns = np.matmul(half[:, chosen], weights).swapaxes(0, 1)
    known = first.factor.unwhiten(columns.reshape(len(half), -1)).reshape(columns.shape).swapaxes(0, 1)
    together = np.concatenate([first.weights - known, weights], axis=1)
    centres = np.concatenate([first.centres, at])
    return KernelExpansion.of(first.hyperparameters, centres, together), left_out
