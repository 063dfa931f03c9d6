"""How near the trials come to every task, and which executions would come nearer."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.special import gammaln

from ctxval._util.arrays import Array
from ctxval.errors import CertificateError

RESOLUTION = 0.125
"""How far from every trial a task may be, in diagonals of the task space, unless the user states more; what lies
farther away may be unlike anything that was seen (docs/calibration.md)."""

_PROBES = 8192
"""Random tasks, and as many random corners, whose distances to the trials are looked at."""

_BESIDE = 0.125
"""How far a corner may be from every trial, as a share of what any other task may be. A trial that is merely near to a
corner says little of it: there are none beyond, and a distance often rises steeply towards the corner that is worst."""

_MOST_PARAMETERS = 4
"""Parameters up to which corners are asked for: there are 2^d of them."""


def require_resolution(value: float) -> float:
    """Return how far a task may be from every trial, in diagonals.

    Raises:
        CertificateError: it is not a positive number.
    """
    if not 0 < value < float("inf"):
        raise CertificateError(f"the resolution must be a positive number of diagonals, got {value!r}.")
    return float(value)


def resolved_volume(resolution: float, dimension: int) -> float:
    """Return the share of the unit cube's volume that a ball of this many diagonals' radius has, at most 1."""
    radius = resolution * np.sqrt(dimension)
    log_volume = 0.5 * dimension * np.log(np.pi) - gammaln(0.5 * dimension + 1) + dimension * np.log(radius)
    return float(np.exp(min(log_volume, 0.0)))


def farthest_task(X: Array) -> float:
    """Return how far a point of the cube is from ``(n, d)`` at most, in diagonals, by many random ones and corners."""
    return float(_gaps(X, _probes(X.shape[1])).max())


def bare_corners(X: Array, resolution: float) -> Array:
    """Return the corners ``(k, d)`` of the cube that no trial is at or beside; of few parameters, else none.

    Args:
        X: the trials' points ``(n, d)``.
        resolution: how far a task may be, in diagonals; a corner must be eight times nearer. With 1 none is bare.
    """
    d = X.shape[1]
    if d > _MOST_PARAMETERS or resolution >= 1:
        return np.empty((0, d))
    corners = np.array(list(product((0.0, 1.0), repeat=d)))
    return np.asarray(corners[_gaps(X, corners) > _BESIDE * resolution])


def covering(X: Array, resolution: float, most: int) -> Array | None:
    """Return the points ``(k, d)`` whose execution would leave no task too far from every trial; None without such.

    First the bare corners, then each is the task that is farthest from the trials and from the points before it.

    Args:
        X: the trials' points ``(n, d)``.
        resolution: how far a task may be, in diagonals.
        most: how many points there may be.
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
    """Return the point that many others are near to and every trial is far from; None where all are beside trials.

    Args:
        points: where a distance may be highest, as the highest draws of it have it, shape ``(k, d)``.
        X: the trials' points ``(n, d)``.
        resolution: how far a task may be from every trial, in diagonals.
    """
    gaps = _gaps(X, points)
    near = (cdist(points, points) / np.sqrt(X.shape[1]) <= resolution / 2).sum(axis=1)
    best = int((gaps * near).argmax())
    return points[best] if gaps[best] > _BESIDE * resolution else None


def _probes(d: int) -> Array:
    rng = np.random.default_rng(0)
    corners = rng.integers(0, 2, (_PROBES, d)).astype(np.float64)
    return np.concatenate([rng.random((_PROBES, d)), corners])


def _gaps(X: Array, probes: Array) -> Array:
    distances, _ = KDTree(X).query(probes)
    return np.asarray(distances / np.sqrt(X.shape[1]))
