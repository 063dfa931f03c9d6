"""The posterior of the residual dynamics for one draw of the hyperparameters, and functions that are drawn from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.gp.kernels import CholeskyFactor, factorise, pivoted_cholesky, tenfold
from ctxval.learning.hyperparameters import Hyperparameters
from ctxval.learning.kernel_expansion import KernelExpansion


@dataclass(frozen=True, eq=False)
class Component:
    """The posterior of r for one draw of the hyperparameters.

    Attributes:
        centres: standardised pairs that it is conditioned on, shape ``(M, k)``.
        factor: Cholesky factor of their covariance with noise.
        weights: weights of the mean, shape ``(M, n)``.
        squares: squared size of each state's residuals, relative to the covariance, shape ``(n,)``.
        amplitudes: standard deviations of the states' residuals, relative to the covariance, shape ``(n,)``.
    """

    hyperparameters: Hyperparameters
    centres: Array
    factor: CholeskyFactor
    weights: Array
    squares: Array
    amplitudes: Array

    @classmethod
    def conditioned(cls, hyperparameters: Hyperparameters, Z: Array, Y: Array, rng: np.random.Generator) -> Component:
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
    own = alike[0]
    chosen, L, left_out = own.pivots(relevant, pivots)
    if not len(chosen):
        weights = np.repeat(own.weights[None], count * len(alike), axis=0)
        return KernelExpansion.of(own.hyperparameters, own.centres, weights), left_out
    kernel, theta = own.hyperparameters.kernel, own.hyperparameters.theta
    shape = (count, len(chosen), own.weights.shape[1])
    normal = np.concatenate([rng.standard_normal(shape) * one.amplitudes for one in alike])
    # The values L xi at the pivots are interpolated by the posterior covariance L L', with weights L'^-1 xi.
    weights = np.linalg.solve(L.T, normal)
    cross = own.factor.solve(kernel(theta, own.centres, relevant[chosen]))
    together = np.concatenate([own.weights - np.matmul(cross, weights), weights], axis=1)
    centres = np.concatenate([own.centres, relevant[chosen]])
    return KernelExpansion.of(own.hyperparameters, centres, together), left_out
