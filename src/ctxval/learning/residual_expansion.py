"""Residual dynamics as sums of covariances with centres, and their weights without some of the data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval.gp.cholesky import factorise, tenfold

_MISFIT = 1e-6
"""Largest error of standardised residuals at centres that rounding may cause."""
_CACHED = 20_000
"""Number of covariances that stay in the processor's cache while they are computed."""


@dataclass(frozen=True, eq=False)
class ResidualExpansion:
    """A sum of covariances with centres, as a function of standardised pairs ``(q, k)``.

    Attributes:
        factors: factors of a pair, of its squared entries and of 1 in the squared arguments of the Matern function,
            shape ``(2 k + 1, M)``.
        weights: weights of the Matern part, shape ``(M, n)``, or ``(q, M, n)`` if each pair has its own.
        linear: the same factors in the linear part, shape ``(2 k + 1, n)``, or with the same first axis.
    """

    factors: Array
    weights: Array
    linear: Array

    @classmethod
    def of(cls, theta: Array, centres: Array, weights: Array) -> ResidualExpansion:
        """Return the expansion with centres ``(M, k)``, and weights of the whole covariance."""
        variance, scales, constant, slope = _parts(theta)
        inverse = 5 / scales**2
        squares = (inverse * centres**2).sum(axis=1)
        factors = [*(-2 * inverse * centres).T, *np.repeat(inverse[:, None], len(centres), axis=1), squares]
        slopes = slope * np.matmul(centres.T, weights)
        constants = constant * weights.sum(axis=-2, keepdims=True)
        return cls(
            np.stack(factors), variance * weights, np.concatenate([slopes, np.zeros_like(slopes), constants], axis=-2)
        )

    def __call__(self, rows: Array) -> Array:
        """Return the values ``(q, n)`` at standardised pairs ``(q, k)``."""
        q, k = rows.shape
        extended = np.empty((q, 2 * k + 1))
        extended[:, :k] = rows
        np.multiply(rows, rows, out=extended[:, k : 2 * k])
        extended[:, -1] = 1.0
        if self.weights.ndim == 3:
            covariances = self._covariances(extended)[:, None, :]
            found = np.matmul(covariances, self.weights) + np.matmul(extended[:, None, :], self.linear)
            return np.asarray(found[:, 0])
        output = extended @ self.linear
        # Blocks whose covariances stay in the processor's cache take half the time.
        size = max(1, _CACHED // self.factors.shape[1])
        for first in range(0, q, size):
            block = slice(first, first + size)
            output[block] += self._covariances(extended[block]) @ self.weights
        return np.asarray(output)

    def _covariances(self, extended: Array) -> Array:
        """Return the Matern 5/2 covariances ``(q, M)`` of unit variance of pairs with their squares and 1."""
        r2 = extended @ self.factors
        np.abs(r2, out=r2)  # rounding errors around zero
        r = np.sqrt(r2)
        r2 *= 1 / 3
        r2 += r
        r2 += 1
        np.negative(r, out=r)
        np.exp(r, out=r)
        r *= r2
        return np.asarray(r)


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
        if not np.abs(misfit).max(initial=0.0) < _MISFIT:
            own[kept] = factorise(covariance[np.ix_(kept, kept)], tenfold(noise)).solve(outputs[kept])
    return found


def _parts(theta: Array) -> tuple[float, Array, float, float]:
    """Return Matern variance, length-scales, and the linear kernel's constant and slope variances."""
    values = np.exp(theta)
    return float(values[0]), values[1:-2], float(values[-2]), float(values[-1])
