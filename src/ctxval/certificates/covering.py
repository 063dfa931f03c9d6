"""Coverage of the task space: the distance from any task to its nearest trial, and executions that reduce it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import scipy

from ctxval._util.arrays import Array

RESOLUTION = 0.125
"""Default of the largest distance from a task to its nearest trial, in diagonals of the task space. Farther away the
distance d may behave in ways that no trial has shown (docs/calibration.md)."""

# Largest distance from a corner to its nearest trial, as a share of what is allowed for other tasks. A trial merely
# near a corner tells little about it: no trial lies beyond, and d often rises steeply towards the worst corner.
_NEXT_TO = 0.125


def resolved_volume(resolution: float, dimension: int) -> float:
    """Return the volume of a ball as a share of the unit cube, at most 1; its radius is in diagonals of the cube."""
    radius = resolution * np.sqrt(dimension)
    log_volume = (
        0.5 * dimension * np.log(np.pi) - scipy.special.gammaln(0.5 * dimension + 1) + dimension * np.log(radius)
    )
    return float(np.exp(min(log_volume, 0.0)))


def farthest_task(X: Array) -> float:
    """Return the largest distance from points of the cube to the nearest row of X ``(n, d)``, in diagonals."""
    return float(_gaps(X, _probes(X.shape[1])).max())


def bare_corners(X: Array, resolution: float) -> Array:
    """Return the corners ``(k, d)`` of the cube that no trial is at or next to; none if d > 4, as there are 2^d."""
    d = X.shape[1]
    if d > 4 or resolution >= 1:
        return np.empty((0, d))
    corners = np.array(list(product((0.0, 1.0), repeat=d)))
    return np.asarray(corners[_gaps(X, corners) > _NEXT_TO * resolution])


def covering(X: Array, resolution: float, most: int) -> Array | None:
    """Return points ``(k, d)`` whose execution would cover the task space; None if more than ``most`` are needed.

    The corners without a trial come first. Each further point is the task that is farthest from all others, until all
    tasks are within the resolution, in diagonals.
    """
    probes = _probes(X.shape[1])
    points: list[Array] = list(bare_corners(X, resolution))
    if len(points) > most:
        return None
    gaps = _gaps(np.concatenate([X, *[point[None] for point in points]]), probes)
    while gaps.max() > resolution:
        if len(points) == most:
            return None
        points.append(probes[int(gaps.argmax())])
        gaps = np.minimum(gaps, np.linalg.norm(probes - points[-1], axis=1) / np.sqrt(X.shape[1]))
    return np.array(points).reshape(-1, X.shape[1])


def most_contested(points: Array, X: Array, resolution: float) -> Array | None:
    """Return which of the points ``(k, d)`` is near many others and far from every trial; None if none is."""
    gaps = _gaps(X, points)
    near = (scipy.spatial.distance.cdist(points, points) / np.sqrt(X.shape[1]) <= resolution / 2).sum(axis=1)
    best = int((gaps * near).argmax())
    return points[best] if gaps[best] > _NEXT_TO * resolution else None


@dataclass(frozen=True)
class EmptyBox:
    """A box of two task parameters in which no trial lies, whatever their other parameters are."""

    parameters: tuple[int, int]  #: the indices of the parameters
    low: tuple[float, float]  #: their smallest values, as coordinates of the unit cube
    high: tuple[float, float]  #: their largest values

    @property
    def share(self) -> float:
        """The share of the task space that the box holds."""
        return (self.high[0] - self.low[0]) * (self.high[1] - self.low[1])


def largest_empty_box(X: Array) -> EmptyBox | None:
    """Return the largest box of two task parameters without a row of X ``(n, d)``; None if d is 1."""

    def boxes(pair: tuple[int, int]) -> Iterator[EmptyBox]:
        x, y = X[:, pair].T
        ends = np.unique([0.0, *y, 1.0])
        for low, high in combinations(ends.tolist(), 2):
            inside = np.sort([0.0, *x[(y > low) & (y < high)], 1.0])
            k = int(np.diff(inside).argmax())
            yield EmptyBox(pair, (float(inside[k]), low), (float(inside[k + 1]), high))

    every = (box for pair in combinations(range(X.shape[1]), 2) for box in boxes(pair))
    return max(every, key=lambda box: box.share, default=None)


def _probes(d: int) -> Array:
    rng = np.random.default_rng(0)
    corners = rng.integers(0, 2, (8192, d)).astype(np.float64)
    return np.concatenate([rng.random((8192, d)), corners])


def _gaps(X: Array, probes: Array) -> Array:
    distances, _ = scipy.spatial.KDTree(X).query(probes)
    return np.asarray(distances / np.sqrt(X.shape[1]))
