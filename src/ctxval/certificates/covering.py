"""How near the trials come to every task, and which executions would come nearer."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree
from scipy.special import gammaln

from ctxval.arrays import Array
from ctxval.errors import CertificateError

RESOLUTION = 0.125
"""How far from every trial a task may be, in diagonals of the task space, unless the user states more; what lies
farther away may be unlike anything that was seen (docs/calibration.md)."""

_PROBES = 8192


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


def covering(X: Array, resolution: float, most: int) -> Array | None:
    """Return the points ``(k, d)`` whose execution would leave no task too far from every trial; None without such.

    Each is the task that is farthest from the trials and from the points before it.

    Args:
        X: the trials' points ``(n, d)``.
        resolution: how far a task may be, in diagonals.
        most: how many points there may be.
    """
    probes = _probes(X.shape[1])
    gaps = _gaps(X, probes)
    points: list[Array] = []
    while gaps.max() > resolution:
        if len(points) == most:
            return None
        points.append(probes[int(gaps.argmax())])
        gaps = np.minimum(gaps, np.linalg.norm(probes - points[-1], axis=1) / np.sqrt(X.shape[1]))
    return np.array(points).reshape(-1, X.shape[1])


def _probes(d: int) -> Array:
    rng = np.random.default_rng(0)
    corners = rng.integers(0, 2, (_PROBES, d)).astype(np.float64)
    return np.concatenate([rng.random((_PROBES, d)), corners])


def _gaps(X: Array, probes: Array) -> Array:
    distances, _ = KDTree(X).query(probes)
    return np.asarray(distances / np.sqrt(X.shape[1]))
