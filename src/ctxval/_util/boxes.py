"""Maximising functions over boxes: the steps that every search for a maximum has in common."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from ctxval._util.arrays import Array

Box = tuple[Array, Array]  #: the lower and upper bounds ``(d,)`` of a box
Sloped = Callable[[Array], tuple[Array, Array]]  #: points ``(..., d)`` -> values ``(...)`` and gradients ``(..., d)``


def latin_hypercube(count: int, dimension: int, rng: np.random.Generator) -> Array:
    """Return points ``(n, d)`` of the unit cube in random order: each n-th of each coordinate's range has one."""
    # scipy.stats has such a function, too, and takes a second to load.
    parts = rng.permuted(np.tile(np.arange(count), (dimension, 1)), axis=1).T
    return np.asarray((parts + rng.random((count, dimension))) / count)


def climb(
    function: Sloped,
    starts: Array,
    low: Array,
    high: Array,
    *,
    scale: float = 1.0,
    iterations: int | None = None,
    evaluations: int | None = None,
) -> tuple[Array, float]:
    """Climb from starts ``(..., d)`` with L-BFGS-B; return the points reached and the sum of their values.

    The sum of the values is separable, so one quasi-Newton search serves all starts. The tolerances of L-BFGS-B refer
    to the scale, which is the size of the sum; iterations and evaluations are its limits.
    """

    def negative(flat: Array) -> tuple[float, Array]:
        values, gradients = function(flat.reshape(starts.shape))
        return -float(values.sum()) / scale, -gradients.ravel() / scale

    count = starts.size // len(low)
    bounds = list(zip(np.tile(low, count), np.tile(high, count), strict=True))
    limits = {"maxiter": iterations, "maxfun": evaluations}
    options = {key: value for key, value in limits.items() if value is not None}
    end = scipy.optimize.minimize(negative, starts.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(np.clip(end.x.reshape(starts.shape), low, high)), -float(end.fun) * scale


def moves_to_bounds(points: Array, low: Array, high: Array) -> Array:
    """Return points ``(..., d)`` with one coordinate moved to a bound, ``(..., 2 d, d)``, lower bounds first."""
    d = len(low)
    moves = np.tile(np.eye(d, dtype=bool), (2, 1))
    ends = np.repeat([low, high], d, axis=0)
    return np.where(moves, ends, points[..., None, :])


def polish(
    function: Callable[[Array], Array], points: Array, values: Array, box: Box, rounds: int, least: Array | float = 0.0
) -> tuple[Array, Array]:
    """Move coordinates of each point to bounds of a box, the best move first, while the value grows by the least.

    The function maps points ``(s, q, d)`` to values ``(s, q)``; the points ``(s, d)`` have the values ``(s,)``.
    """
    rows = np.arange(len(points))
    for _ in range(rounds):
        moved = moves_to_bounds(points, *box)
        heights = function(moved)
        best = heights.argmax(axis=1)
        better = heights[rows, best] > values + least
        if not better.any():
            break
        values = np.where(better, heights[rows, best], values)
        points = np.where(better[:, None], moved[rows, best], points)
    return points, values


def separated_rows(points: Array, reach: float, count: int) -> list[int]:
    """Return the first rows of points ``(n, d)`` that are farther than ``reach`` from every row chosen before them."""
    chosen: list[int] = []
    left = np.ones(len(points), dtype=bool)
    while len(chosen) < count and left.any():
        row = int(left.argmax())
        chosen.append(row)
        left &= np.linalg.norm(points - points[row], axis=1) > reach
        left[: row + 1] = False
    return chosen


def farthest_rows(points: Array, gaps: Array, count: int, *, squared: bool = False) -> list[int]:
    """Return rows of points ``(n, d)``, each farthest from all points chosen before it (Gonzalez 1985).

    The gaps ``(n,)`` are the distances of the points to the nearest one that is chosen already; minus infinity if the
    point is one of them.
    """
    left = np.array(gaps, dtype=np.float64)
    rows: list[int] = []
    while len(rows) < count and left.max() > -np.inf:
        row = int(left.argmax())
        distances = ((points - points[row]) ** 2).sum(axis=1)
        left = np.minimum(left, distances if squared else np.sqrt(distances))
        left[row] = -np.inf
        rows.append(row)
    return rows
