"""Cholesky factors: everything that conditions a Gaussian process on data factorises its covariance matrix here.

LAPACK is called directly, without the checks of scipy.linalg, which cost more than a small solve.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows
from ctxval.errors import InputError
from ctxval.gp.kernels import Covariance


@dataclass(frozen=True, eq=False)
class CholeskyFactor:
    """The factor L of a positive definite matrix ``K = L L'``; make one with :func:`factorise`."""

    L: Array  # lower triangular, with zeros above its diagonal (n, n)

    def solve(self, right: Array) -> Array:
        """Return ``K^-1 right`` in the shape of ``right``, ``(n,)`` or ``(n, k)``."""
        return np.asarray(scipy.linalg.lapack.dpotrs(self.L, right, lower=1)[0])

    def whiten(self, right: Array) -> Array:
        """Return ``L^-1 right``; if a column of ``right`` has covariance K, that of the result is the identity."""
        return np.asarray(scipy.linalg.lapack.dtrtrs(self.L, right, lower=1)[0])

    def unwhiten(self, right: Array) -> Array:
        """Return ``L'^-1 right``; of what was whitened before, it is ``K^-1`` times it."""
        return np.asarray(scipy.linalg.lapack.dtrtrs(self.L, right, lower=1, trans=1)[0])

    def whiten_many(self, right: Array) -> Array:
        """Return ``L^-1 right`` by the inverse factor, faster for many contiguous columns; they may be overwritten."""
        return np.asarray(scipy.linalg.blas.dtrmm(1.0, self.inverse_factor, right, lower=1, overwrite_b=1))

    def inverse(self) -> Array:
        """Return ``K^-1``, shape ``(n, n)``."""
        lower = scipy.linalg.lapack.dpotri(self.L, lower=1)[0]  # L is zero above its diagonal, and stays so
        inverse = lower + lower.T
        inverse.ravel("K")[:: len(inverse) + 1] *= 0.5  # its diagonal
        return np.asarray(inverse)

    @functools.cached_property
    def inverse_factor(self) -> Array:
        """``L^-1``, shape ``(n, n)``."""
        return self.whiten(np.eye(len(self.L)))

    def precisions_of(self, rows: Rows) -> Array:
        """Return entries of the diagonal of ``K^-1``: inverse variances of observations given all others, ``(k,)``."""
        units = np.zeros((len(self.L), len(rows)), order="F")
        units[rows, np.arange(len(rows))] = 1.0
        return np.asarray((self.whiten(units) ** 2).sum(axis=0))

    def half_log_determinant(self) -> float:
        """Return ``log(det K) / 2``."""
        return float(np.log(np.diag(self.L)).sum())


def factorise(covariance: Array, noise: float, *, insist: bool = False) -> CholeskyFactor:
    """Return the factor of ``covariance + noise I``; to insist is to raise the noise tenfold until it succeeds."""
    for _ in range(31 if insist else 1):
        noisy = np.array(covariance, order="F")
        noisy.ravel("K")[:: len(noisy) + 1] += noise  # its diagonal
        L, info = scipy.linalg.lapack.dpotrf(noisy, lower=1, clean=1, overwrite_a=1)
        if not info and not np.isnan(np.trace(L)):  # some LAPACKs let NaN pass
            return CholeskyFactor(np.asarray(L))
        noise *= 10
    what = f"the covariance of {len(covariance)} observations"
    raise InputError(f"{what} is not positive definite; raise the noise variance.")


def pivoted_rows(kernel: Covariance, theta: Array, X: Array, count: int, least: float) -> Rows:
    """Return at most ``count`` rows by pivoted Cholesky, each with the largest variance given those before it."""
    towards = kernel.towards(theta, X)
    return pivoted_cholesky(kernel.diagonal(theta, X), lambda row: towards(X[row : row + 1])[0], count, least)[0]


def pivoted_cholesky(
    variances: Array, covariances: Callable[[int], Array], count: int, least: float
) -> tuple[Rows, Array, Array]:
    """Return rows ``(k,)`` that represent a covariance matrix, their Cholesky factor ``(k, k)``, and what is left.

    The variances given these rows ``(n,)`` are left. The matrix has the diagonal ``variances`` ``(n,)``, and
    ``covariances`` returns one of its rows in an array that may be overwritten. The choice ends after ``count`` rows,
    or if no remaining variance is larger than ``least``.
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
    return rows, np.tril(columns[: len(rows)][:, rows].T), np.maximum(left, 0.0)


def pivoted_matrix(variances: Array, covariance: Array, count: int, least: float) -> tuple[Rows, Array, Array]:
    """Return what :func:`pivoted_cholesky` returns, for a matrix ``(n, n)`` that is known as a whole."""
    left = np.array(variances)
    if not left.max(initial=0.0) > least:  # LAPACK takes the first row in any case
        return np.empty(0, dtype=np.intp), np.empty((0, 0)), np.maximum(left, 0.0)
    lower, pivots, rank, _ = scipy.linalg.lapack.dpstrf(covariance, lower=1, tol=least)
    k, order = min(int(rank), count), pivots.astype(np.intp) - 1
    left[order[:k]] = 0.0
    left[order[k:]] -= (lower[k:, :k] ** 2).sum(axis=1)
    return order[:k], np.tril(lower[:k, :k]), np.maximum(left, 0.0)
