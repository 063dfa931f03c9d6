"""Float64 arrays with clear errors, and linear algebra on one thread.

Small dense algebra is slower on many BLAS threads, and its last bits depend on the number of threads.
"""

from __future__ import annotations

import functools
import importlib
import math
import reprlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

from ctxval.errors import InputError, ShapeError

Array = npt.NDArray[np.float64]  #: an array of numbers in double precision
Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]
ArrayLike = npt.ArrayLike

_SHOWN = reprlib.Repr()
_SHOWN.maxlist = _SHOWN.maxtuple = 20
_SHOWN.maxstring = _SHOWN.maxother = 200


def as_floats(name: str, value: ArrayLike) -> Array:
    """Return numbers as an array. What numpy would convert is refused: texts, booleans, masked and complex numbers."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    if _has(value, np.ma.is_masked, np.ma.MaskedArray):
        advice = "fill in the masked entries, or replace them with NaN"
        raise InputError(f"{name} must be numbers without masked entries; {advice}.")
    try:
        array = np.asarray(value)
        items = array.tolist() if array.dtype == object else value
        if array.dtype.kind not in "fiuO" or _has(items, _is_no_number, str | bytes | bool | np.bool_ | np.ndarray):
            raise TypeError
        return np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} must be numbers, got {_SHOWN.repr(value)}.") from error


def _has(value: object, wrong: Callable[[Any], bool], kinds: Any) -> bool:
    """Return whether a value of some kinds, or one in lists of lists, is a wrong one."""
    if isinstance(value, list | tuple):
        return any(_has(item, wrong, kinds) for item in value)
    return isinstance(value, kinds) and bool(wrong(value))


def _is_no_number(value: Any) -> bool:
    return not isinstance(value, np.ndarray) or value.dtype.kind not in "fiuO"


def as_finite(name: str, value: ArrayLike) -> Array:
    array = as_floats(name, value)
    finite = np.isfinite(array)
    if not finite.all():
        if array.size <= 100:
            raise InputError(f"{name} must be finite, got {array.tolist()}.")
        place = tuple(np.argwhere(~finite)[0].tolist())
        raise InputError(f"{name} must be finite, got {array[place]} at {list(place)}.")
    return array


def read_only(array: Array) -> Array:
    """Return an array that neither its reader nor the owner of the given one can change."""
    if array.flags.writeable:
        array = array.copy()
        array.setflags(write=False)
    return array


def require_shape(name: str, array: Array, expected: tuple[int, ...]) -> Array:
    """Return ``array`` if its last axes are ``expected``."""
    if array.shape[array.ndim - len(expected) :] != expected or array.ndim < len(expected):
        wanted = ", ".join(["...", *map(str, expected)])
        raise ShapeError(f"{name} must have shape ({wanted}), got {array.shape}.")
    return array


def as_weight(name: str, value: ArrayLike) -> Array:
    """Return a square weight matrix from a matrix or from its diagonal."""
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


@functools.cache
def _thread_pools(scipy: bool) -> ThreadpoolController:
    if scipy:
        importlib.import_module("scipy.linalg")  # it has an algebra library of its own, which may not be loaded yet
    return ThreadpoolController()


def single_threaded(*, scipy: bool = True) -> AbstractContextManager[Any]:
    """Limit BLAS to one thread inside the context; without ``scipy``, which takes time to load, that of numpy alone."""
    return _thread_pools(scipy).limit(limits=1)  # type: ignore[no-any-return]


def held_means(times: Array, values: Array, edges: Array, slack: float) -> Array:
    """Return the means ``(K, m)`` of values ``(N, m)`` that hold from their times on, between edges ``(K + 1,)``.

    The times increase, and the first value also holds before. A time within the slack of an edge is that of the edge.
    """
    first = np.maximum(np.searchsorted(times, edges[:-1] + slack, side="right") - 1, 0)
    last = np.maximum(np.searchsorted(times, edges[1:] - slack) - 1, first)
    areas = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values[:-1] * np.diff(times)[:, None], axis=0)])
    until = areas[last] + values[last] * (edges[1:] - times[last])[:, None]
    since = areas[first] + values[first] * (edges[:-1] - times[first])[:, None]
    means = (until - since) / np.diff(edges)[:, None]
    within = np.clip(means, values.min(axis=0), values.max(axis=0))  # in spite of rounding
    return np.asarray(np.where((first == last)[:, None], values[first], within))
