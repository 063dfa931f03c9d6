"""Float64 arrays with clear errors, and linear algebra on one thread.

Small dense algebra is slower on many BLAS threads, and its last bits depend on the number of threads.
"""

from __future__ import annotations

import functools
import math
import reprlib
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

from ctxval.errors import InputError, ShapeError

Array = npt.NDArray[np.float64]
"""An array of numbers in double precision."""
Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]
ArrayLike = npt.ArrayLike

_LISTED = 100
"""Largest number of values that an error message lists."""

_SHOWN = reprlib.Repr()
_SHOWN.maxlist = _SHOWN.maxtuple = 20
_SHOWN.maxstring = _SHOWN.maxother = 200


def as_floats(name: str, value: ArrayLike) -> Array:
    """Return ``value`` as a float64 array.

    Raises:
        InputError: if the value is not numeric, or has masked entries.
    """
    if _is_masked(value):
        raise InputError(
            f"{name} must be numbers without masked entries; fill in the masked entries, or replace them with NaN."
        )
    try:
        if np.iscomplexobj(value):
            raise TypeError
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers, got {_SHOWN.repr(value)}.") from error


def _is_masked(value: object) -> bool:
    """Return whether a value has masked entries; ``numpy.asarray`` would silently return the numbers below the mask."""
    if isinstance(value, list | tuple):
        return any(_is_masked(item) for item in value if isinstance(item, list | tuple | np.ma.MaskedArray))
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))


def as_finite(name: str, value: ArrayLike) -> Array:
    """Return ``value`` as a float64 array without NaN and infinity.

    Raises:
        InputError: if the value is not numeric, or not finite.
    """
    array = as_floats(name, value)
    finite = np.isfinite(array)
    if not finite.all():
        if array.size <= _LISTED:
            raise InputError(f"{name} must be finite, got {array.tolist()}.")
        place = tuple(np.argwhere(~finite)[0].tolist())
        raise InputError(f"{name} must be finite, got {array[place]} at {list(place)}.")
    return array


def positive_count(sentence: str, count: object) -> int:
    """Return a positive integer.

    Args:
        sentence: the beginning of the message, which says what must be positive.
        count: the value.

    Raises:
        InputError: if the value is no integer, or is below 1.
    """
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
        raise InputError(f"{sentence}, got {count!r}.")
    return int(count)


def count_from_zero(name: str, count: object) -> int:
    """Return an integer that is at least 0, such as a seed.

    Raises:
        InputError: if the value is no integer, or is below 0.
    """
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 0:
        raise InputError(f"{name} must be an integer >= 0, got {count!r}.")
    return int(count)


def require_shape(name: str, array: Array, expected: tuple[int, ...]) -> Array:
    """Return ``array`` if its last axes are ``expected``.

    Raises:
        ShapeError: if the last axes differ; the message names both shapes.
    """
    if array.shape[array.ndim - len(expected) :] != expected or array.ndim < len(expected):
        wanted = ", ".join(["...", *map(str, expected)])
        raise ShapeError(f"{name} must have shape ({wanted}), got {array.shape}.")
    return array


def as_weight(name: str, value: ArrayLike) -> Array:
    """Return a square weight matrix from a matrix or from its diagonal.

    Raises:
        ShapeError: if the value is neither a square matrix nor a diagonal.
        InputError: if the matrix is not finite, not symmetric, or has a negative eigenvalue.
    """
    array = as_finite(name, value)
    if array.ndim == 1:
        array = np.diag(array)
    if array.ndim != 2 or array.shape[0] != array.shape[1] or not array.size:
        raise ShapeError(f"{name} must be a diagonal or a square matrix, not empty, got shape {np.shape(value)}.")
    scale = max(1.0, float(np.abs(array).max(initial=0.0)))
    if not np.allclose(array, array.T, rtol=0, atol=1e-10 * scale):
        raise InputError(f"{name} must be symmetric, got {array.tolist()}.")
    if np.linalg.eigvalsh(array).min() < -1e-10 * scale:
        raise InputError(f"{name} must have no negative eigenvalue, got {array.tolist()}.")
    return array


def rows_of(array: Array) -> Array:
    """Return the vectors ``(..., k)`` of an array as rows ``(N, k)``; k may be 0, as a system may have no inputs."""
    return array.reshape(math.prod(array.shape[:-1]), array.shape[-1])


def vector_norm(vectors: Array, order: float) -> Array:
    """Return the ``order``-norm (1, 2 or infinity) over the last axis."""
    magnitudes = np.abs(vectors)
    if order == 1:
        return np.asarray(magnitudes.sum(axis=-1))
    if order == np.inf:
        return np.asarray(magnitudes.max(axis=-1))
    return np.asarray(np.sqrt((magnitudes**2).sum(axis=-1)))


def as_norm_order(value: float) -> float:
    """Return the order of a norm.

    Raises:
        InputError: if the value is not 1, 2 or infinity.
    """
    if value not in (1, 2, np.inf):
        raise InputError(f"norm must be 1, 2 or inf, got {value!r}.")
    return float(value)


@functools.cache
def _thread_pools() -> ThreadpoolController:
    return ThreadpoolController()


def single_threaded() -> AbstractContextManager[Any]:
    """Limit BLAS to one thread inside the context."""
    limits: AbstractContextManager[Any] = _thread_pools().limit(limits=1)
    return limits
