"""What a surrogate keeps of a history that is too long for exact regression."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array, Rows

LONG = 1000
"""Points from which on a history is too long: below, all of it is kept."""


def kept_rows(points: Array, values: Array, count: int) -> Rows:
    """Return the rows that stand for a history of points ``(n, d)`` and values ``(n,)``, in their order.

    Below 1,000 points these are all. Beyond, a quarter of ``count`` are the largest values, a quarter the latest
    points, pending and failed ones too, and the others are far from those and from each other: where the history was,
    the surrogate must not believe that nobody has looked.
    """
    if len(values) < LONG:
        return np.arange(len(values))
    largest = np.argsort(-np.nan_to_num(values, nan=-np.inf), kind="stable")[: count // 4]
    latest = np.arange(len(values) - count // 4, len(values))
    chosen = np.unique(np.concatenate([largest, latest]))
    return np.sort(np.concatenate([chosen, _far_from(points, chosen, count - len(chosen))]))


def _far_from(points: Array, chosen: Rows, count: int) -> Rows:
    """Return so many rows, each farthest from all that are chosen before it (Gonzalez 1985)."""
    gaps = cdist(points, points[chosen], "sqeuclidean").min(axis=1)
    gaps[chosen] = -np.inf  # also among copies of one point no row is taken twice
    rows = np.empty(count, dtype=np.intp)
    for i in range(count):
        rows[i] = gaps.argmax()
        gaps = np.minimum(gaps, ((points - points[rows[i]]) ** 2).sum(axis=1))
        gaps[rows[i]] = -np.inf
    return rows
