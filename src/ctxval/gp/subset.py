"""Subsets of data that represent all of them, if exact regression on all would take too long."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array, Rows
from ctxval._util.boxes import farthest_rows
from ctxval.gp.kernels import Covariance

LONG = 1000
"""Length of a history from which on only a subset is kept."""


def kept_rows(points: Array, values: Array, count: int, long: int = LONG) -> Rows:
    """Return the rows that represent a history of points ``(n, d)`` and values ``(n,)``, in their order.

    Below ``long`` points these are all rows. From then on, a quarter of ``count`` rows have the largest values, a
    quarter are the latest, including pending and failed ones, and the others are far from those and from each other.
    So the surrogate keeps its knowledge of all regions that the history has explored.
    """
    if len(values) < long:
        return np.arange(len(values))
    largest = np.argsort(-np.nan_to_num(values, nan=-np.inf), kind="stable")[: count // 4]
    latest = np.arange(len(values) - count // 4, len(values))
    chosen = np.unique(np.concatenate([largest, latest]))
    gaps = cdist(points, points[chosen], "sqeuclidean").min(axis=1)
    gaps[chosen] = -np.inf
    others = farthest_rows(points, gaps, count - len(chosen), squared=True)
    return np.sort(np.concatenate([chosen, np.array(others, dtype=np.intp)]))


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
