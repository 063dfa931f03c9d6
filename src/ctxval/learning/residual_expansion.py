"""Residual dynamics as sums of covariances with centres, and their weights without some of the data."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import call
from ctxval.gp.cholesky import factorise, tenfold

_MISFIT = 1e-6
"""Largest error of standardised residuals at centres that rounding may cause."""
_CACHED = 20_000
"""Number of covariances that stay in the processor's cache while they are computed."""


@dataclass(frozen=True, eq=False)
class ResidualExpansion:
    """A sum of covariances with centres, as a function of standardised pairs ``(q, k)``.

    Attributes:
        scales: length-scales of the Matern part, shape ``(k,)``.
        centres: the centres in units of the length-scales, shape ``(M, k)``.
        weights: weights of the Matern part, shape ``(M, n)``, or ``(q, M, n)`` if each pair has its own.
        constant, slopes: the linear part, shapes ``(n,)`` and ``(k, n)``, or with the same first axis.
    """

    scales: Array
    centres: Array
    weights: Array
    constant: Array
    slopes: Array

    @classmethod
    def of(cls, theta: Array, centres: Array, weights: Array) -> ResidualExpansion:
        """Return the expansion with centres ``(M, k)``, and weights of the whole covariance."""
        variance, scales, constant, slope = _parts(theta)
        linear = constant * weights.sum(axis=-2), slope * np.matmul(centres.T, weights)
        return cls(scales, centres / scales, variance * weights, *linear)

    def __call__(self, rows: Array) -> Array:
        """Return the values ``(q, n)`` at standardised pairs ``(q, k)``."""
        own = rows / self.scales
        if self.weights.ndim == 3:
            covariances = self._covariances(own)
            linear = self.constant + np.matmul(rows[:, None, :], self.slopes)[:, 0]
            return np.asarray(np.matmul(covariances[:, None, :], self.weights)[:, 0] + linear)
        output = self.constant + rows @ self.slopes
        # Blocks whose covariances stay in the processor's cache take half the time.
        size = max(1, _CACHED // len(self.centres))
        for first in range(0, len(rows), size):
            block = slice(first, first + size)
            output[block] += self._covariances(own[block]) @ self.weights
        return output

    def _covariances(self, own: Array) -> Array:
        """Return the Matern 5/2 covariances ``(q, M)`` of pairs in units of the length-scales, of unit variance."""
        q, k = own.shape
        extended = np.ones((q, k + 2))
        extended[:, :k] = own
        extended[:, k] = np.einsum("ij,ij->i", own, own)
        r2 = extended @ self._factors
        np.abs(r2, out=r2)  # rounding errors around zero
        r = np.sqrt(r2)
        r2 *= 1 / 3
        r2 += r
        r2 += 1
        np.negative(r, out=r)
        np.exp(r, out=r)
        r *= r2
        return np.asarray(r)

    @functools.cached_property
    def _factors(self) -> Array:
        """Factors of a pair, of its square and of 1 in five times the squared distances, shape ``(k + 2, M)``."""
        squares = (self.centres**2).sum(axis=1)
        return 5 * np.stack([*(-2 * self.centres.T), np.ones(len(squares)), squares])

    def __repr__(self) -> str:
        return call(self, centres=self.centres, weights=self.weights)


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
