"""Unit quaternions in columns of numbers: products, and interpolation between samples of either sign."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctxval._util.arrays import Array


def product(p: Array, q: Array) -> Array:
    """Return the products ``(..., 4)`` of quaternions, w first."""
    a, b, c, d = np.moveaxis(p, -1, 0)
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + (c * z - d * y),
            a * y + c * w + (d * x - b * z),
            a * z + d * w + (b * y - c * x),
        ],
        axis=-1,
    )


def normalised(q: Array) -> Array:
    """Return quaternions ``(..., 4)`` of length 1."""
    return np.asarray(q / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), 1e-12))


def quaternions_in(columns: Sequence[Array], tolerance: float = 1e-3) -> list[slice]:
    """Return each four columns ``(N,)`` in a row that have length 1 in all samples, as unit quaternions have."""
    found, first = list[slice](), 0
    while first + 4 <= len(columns):
        four = columns[first : first + 4]
        alike = len({len(column) for column in four}) == 1 and len(four[0])
        if alike and np.abs(np.linalg.norm(four, axis=0) - 1.0).max() < tolerance:
            found.append(slice(first, first + 4))
            first += 3
        first += 1
    return found


def continued(q: Array) -> Array:
    """Return quaternions ``(N, 4)``, each with the sign that is nearer to the one before."""
    signs = np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(q * np.concatenate([[1.0], np.cumprod(signs)])[:, None])


def interpolated(times: Array, recorded: Array, states: Array) -> Array:
    """Return states ``(N, n)`` at other times ``(M, n)``: linearly, quaternions on the sphere and with one sign."""
    turning = quaternions_in(list(states.T))
    if turning:
        states = np.array(states)
        for at in turning:
            states[:, at] = continued(states[:, at])
    moved = np.stack([np.interp(times, recorded, column) for column in states.T], axis=-1)
    for at in turning:
        moved[:, at] = normalised(moved[:, at])
    return moved
