"""Subsets of data that represent all of them, if exact regression on all would take too long."""

from __future__ import annotations

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
    """Return rows by pivoted Cholesky: each has the largest variance given the rows before it.

    Args:
        kernel, theta: the covariance and the logarithms of its hyperparameters.
        X: points ``(n, d)``.
        count: largest number of rows.
        least: the choice ends if no remaining variance is larger than this.
    """
    left = kernel.diagonal(theta, X)
    columns = np.zeros((min(count, len(X)), len(X)))
    chosen: list[int] = []
    for k in range(len(columns)):
        pivot = int(np.argmax(left))
        if left[pivot] <= least:
            break
        row = kernel(theta, X[pivot : pivot + 1], X)[0] - columns[:k, pivot] @ columns[:k]
        columns[k] = row / np.sqrt(left[pivot])
        left = left - columns[k] ** 2
        left[pivot] = 0.0
        chosen.append(pivot)
    return np.array(chosen, dtype=np.intp)
