"""Plain descriptions of objects: how a store knows the experiment that it belongs to."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import math
import types
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_DEPTH = 6
_LISTED = 100
_TOLERANCE = 1e-6
"""Floats that a least-squares fit gives on two machines differ by less than this."""


def describe(value: Any, depth: int = _DEPTH) -> Any:
    """Return what identifies an object, as JSON: its type and its public values, or what its ``describe()`` says."""
    if isinstance(value, str | int | bool | type(None)):
        return value
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, float | np.number):
        return float(value) if math.isfinite(value) else str(value)
    if depth == 0:
        return type(value).__qualname__
    if isinstance(value, np.ndarray):
        return _describe_array(value)
    if isinstance(value, Mapping):
        return {str(key): describe(item, depth - 1) for key, item in value.items()}
    if isinstance(value, set | frozenset):
        # Sorted: the order of a set of strings changes from process to process.
        return sorted((describe(item, depth - 1) for item in value), key=repr)
    if isinstance(value, Sequence):
        return [describe(item, depth - 1) for item in value]
    if inspect.isroutine(value) or isinstance(value, functools.partial | type):
        return _describe_callable(value, depth)
    return _describe_object(value, depth)


def _describe_array(array: np.ndarray[Any, Any]) -> Any:
    if array.dtype.kind not in "biuf":
        return [item if isinstance(item, str) else repr(item) for item in array.ravel().tolist()]
    if array.size <= _LISTED:
        return array.tolist()
    # The projection tells apart arrays of the same values in another order.
    projection = float(array.ravel() @ np.cos(np.arange(array.size)))
    summary = {"mean": float(array.mean()), "std": float(array.std()), "projection": projection}
    return {"shape": list(array.shape), **summary}


def _describe_callable(value: Any, depth: int) -> Any:
    if isinstance(value, functools.partial):
        return {
            "partial": describe(value.func, depth - 1),
            "args": describe(value.args, depth - 1),
            "keywords": describe(value.keywords, depth - 1),
        }
    name = f"{value.__module__}.{value.__qualname__}" if hasattr(value, "__qualname__") else repr(value)
    owner = getattr(value, "__self__", None)
    bound = {"of": describe(owner, depth - 1)} if owner is not None and not inspect.ismodule(owner) else {}
    closed_over = inspect.getclosurevars(value).nonlocals if inspect.isfunction(value) else {}
    enclosed = {key: describe(item, depth - 1) for key, item in closed_over.items()}
    defaults = (getattr(value, "__defaults__", None) or (), getattr(value, "__kwdefaults__", None) or {})
    if any(defaults):
        enclosed["defaults"] = describe(defaults, depth - 1)
    if inspect.isfunction(value):
        enclosed["constants"] = _constants(value.__code__)
    return {"function": name, **bound, **enclosed} if bound or enclosed else name


def _constants(code: types.CodeType) -> str:
    """Return a digest of a function's names and constants: what an edit of its formula mostly changes.

    The bytecode itself is left out, as it differs between versions of Python.
    """
    constants = [
        _constants(item)
        if isinstance(item, types.CodeType)
        else repr(sorted(map(repr, item)) if isinstance(item, frozenset) else item)
        for item in code.co_consts
    ]
    return hashlib.sha256(repr((code.co_names, constants)).encode()).hexdigest()[:16]


def _describe_object(value: Any, depth: int) -> Any:
    own = getattr(value, "describe", None)
    fields = own() if callable(own) else {k: v for k, v in _attributes(value).items() if not k.startswith("_")}
    return {"type": type(value).__qualname__, **{key: describe(item, depth - 1) for key, item in fields.items()}}


def _attributes(value: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    try:
        return dict(vars(value))
    except TypeError:
        return {}


def first_difference(stored: Any, present: Any, path: str = "") -> str | None:
    """Return where two descriptions first differ, as ``"path: stored, present"``; None where they agree.

    Floats agree within a relative 1e-6, so that a model fitted again on another machine is the same model.
    """
    if isinstance(stored, dict) and isinstance(present, dict):
        for key in [*stored, *(key for key in present if key not in stored)]:
            here = f"{path}.{key}" if path else key
            if (key in stored) != (key in present):
                return f"{here} is {'missing now' if key in stored else 'new'}"
            found = first_difference(stored[key], present[key], here)
            if found:
                return found
        return None
    if isinstance(stored, list) and isinstance(present, list) and len(stored) == len(present):
        pairs = enumerate(zip(stored, present, strict=True))
        return next((found for i, (a, b) in pairs if (found := first_difference(a, b, f"{path}[{i}]"))), None)
    if _same(stored, present):
        return None
    return f"{path} was {_short(stored)} and is now {_short(present)}"


def _same(stored: Any, present: Any) -> bool:
    if isinstance(stored, int | float) and isinstance(present, int | float):
        both_nan = math.isnan(stored) and math.isnan(present)
        return both_nan or math.isclose(stored, present, rel_tol=_TOLERANCE, abs_tol=1e-13)
    return bool(stored == present)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
