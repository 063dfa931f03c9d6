"""Plain descriptions of objects, by which a store recognises the experiment that it belongs to.

A description covers what an object computes: its values, and for functions and classes of users the syntax tree
without docstrings and annotations, with the outer values that the code uses. The location of a module does not matter.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import math
import numbers
import re
import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ctxval._util.code_digest import Code, bytecode_digest, code_of, is_library, is_own, same_package

_DEPTH = 6
_LISTED = 100
_TOLERANCE = 1e-6
"""Relative tolerance of floats: the results of a least-squares fit on two machines differ by less than this."""

_MISSING = object()


def describe(value: Any, depth: int = _DEPTH, *, private: bool = False) -> Any:
    """Return the identity of an object as JSON: its type and its public values, or the result of its ``describe()``.

    Args:
        value: the object.
        depth: number of levels of nested objects that are described.
        private: describe attributes too if their names begin with an underscore.
    """
    return _Description(private).of(value, depth)


class _Description:
    """One description, in which the code of each function and class appears once."""

    def __init__(self, private: bool) -> None:
        self.private = private
        self._known: set[int] = set()

    def of(self, value: Any, depth: int) -> Any:
        if isinstance(value, str | int | bool | type(None)):
            return value
        if isinstance(value, np.bool_):
            return bool(value)
        if isinstance(value, float | np.number):
            return float(value) if math.isfinite(value) else str(value)
        if isinstance(value, numbers.Number | range):
            return repr(value)
        if isinstance(value, bytes | bytearray | memoryview):
            return {"bytes": len(value), "sha256": hashlib.sha256(value).hexdigest()}
        if depth == 0:
            return type(value).__qualname__
        if isinstance(value, np.ndarray):
            if any(is_own(type(item)) for item in (value.flat if value.dtype.hasobject else ())):
                return self.of(value.ravel().tolist(), depth)  # our own objects show themselves rounded
            return _describe_array(value)
        if isinstance(value, Mapping):
            return {str(key): self.of(item, depth - 1) for key, item in value.items()}
        if isinstance(value, set | frozenset):
            # Sorted, because the order of a set of strings changes from process to process.
            return sorted((self.of(item, depth - 1) for item in value), key=repr)
        if isinstance(value, Sequence):
            return [self.of(item, depth - 1) for item in value]
        if inspect.isroutine(value) or isinstance(value, functools.partial | type):
            return self._callable(value, depth)
        return self._object(value, depth)

    def _callable(self, value: Any, depth: int) -> Any:
        if isinstance(value, functools.partial):
            return {
                "partial": self.of(value.func, depth - 1),
                "args": self.of(value.args, depth - 1),
                "keywords": self.of(value.keywords, depth - 1),
            }
        wrapped = getattr(value, "__wrapped__", None)
        if callable(wrapped) and not inspect.isfunction(value) and not is_library(value):  # e.g. functools.cache
            return {"function": _name(value), "wrapped": self.of(wrapped, depth - 1)}
        owner = getattr(value, "__self__", None)
        bound = {"of": self.of(owner, depth - 1)} if owner is not None and not inspect.ismodule(owner) else {}
        function = getattr(value, "__func__", value)
        enclosed = {key: self.of(item, depth - 1) for key, item in _closed_over(function).items()}
        defaults = (getattr(function, "__defaults__", None) or (), getattr(function, "__kwdefaults__", None) or {})
        if any(defaults):
            enclosed["defaults"] = self.of(defaults, depth - 1)
        code = self._code(function)
        return {"function": _name(function), **bound, **enclosed, **code} if bound or enclosed or code else _name(value)

    def _object(self, value: Any, depth: int) -> Any:
        fields = None if self.private else _own_description(value)
        if fields is None:
            fields = {k: v for k, v in _attributes(value).items() if self.private or not str(k).startswith("_")}
        described = {str(key): self.of(item, depth - 1) for key, item in fields.items()}
        if not fields and self.private:
            with contextlib.suppress(Exception):  # an object that numpy can convert, such as a network's weights
                described["values"] = _describe_array(np.asarray(value, dtype=np.float64))
        return {"type": type(value).__qualname__, **described, **self._class_code(type(value))}

    # Code

    def _class_code(self, cls: type) -> dict[str, Any]:
        found = [self._code(base) for base in cls.__mro__ if base is not object]
        found = [code for code in found if code]
        return {"code": found} if found else {}

    def _code(self, value: Any) -> dict[str, Any]:
        """Return the digest of a user's function or class, and everything that it uses, at any depth, each once."""
        if is_own(value) or is_library(value) or id(value) in self._known:
            return {}
        self._known.add(id(value))
        code = code_of(value)
        if code is not None:
            used = {name: self._used(value, item) for name, item in _outer(value, code)}
            return {"digest": code.digest, **({"uses": used} if used else {})}
        digest = bytecode_digest(value)
        return {} if digest is None else {"digest": digest}

    def _used(self, user: Any, value: Any) -> Any:
        if inspect.ismodule(value):
            return value.__name__
        if inspect.isroutine(value) or isinstance(value, type):
            if is_own(value) or (is_library(value) and not same_package(user, value)):
                return _name(value)
            return self._callable(value, _DEPTH)
        return type(value).__qualname__ if _is_tool(value) else self.of(value, _DEPTH)


def _is_tool(value: Any) -> bool:
    """Return whether a value is not data but an object of Python's standard library, such as a logger or a lock."""
    module = type(value).__module__.partition(".")[0]
    return module != "builtins" and module in sys.stdlib_module_names and not isinstance(value, _DATA)


_DATA = (str, numbers.Number, Mapping, Sequence, set, frozenset, functools.partial, types.SimpleNamespace)


def _closed_over(function: Any) -> dict[str, Any]:
    """Return the variables that a function closes over; variables without a value are left out."""
    if not inspect.isfunction(function):
        return {}
    found = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):
            found[name] = cell.cell_contents
    return found


def _own_description(value: Any) -> Mapping[str, Any] | None:
    """Return the result of an object's own ``describe()``.

    Returns None if there is no such method, if it fails or returns no mapping, or if it belongs to another library,
    in which ``describe`` means something else.
    """
    cls = type(value)
    if not callable(getattr(cls, "describe", None)) or (is_library(cls) and not is_own(cls)):
        return None
    try:
        found = value.describe()
    except Exception:
        return None
    return found if isinstance(found, Mapping) else None


def _outer(value: Any, code: Code) -> list[tuple[str, Any]]:
    """Return the outer names that code uses, with their values."""
    outside = _globals_of(value)
    found = []
    for dotted in code.names:
        root, *attributes = dotted.split(".")
        item = outside.get(root, _MISSING)
        seen = root
        for attribute in attributes:
            # Only attributes of modules are resolved; an attribute of an object is part of the object's value.
            if not inspect.ismodule(item) or not hasattr(item, attribute):
                break
            item, seen = getattr(item, attribute), f"{seen}.{attribute}"
        if item is not _MISSING and item is not value:
            found.append((seen, item))
    return found


def _globals_of(value: Any) -> Mapping[str, Any]:
    if inspect.isfunction(value):
        return value.__globals__
    module = sys.modules.get(value.__module__)
    return {} if module is None else vars(module)


def _name(value: Any) -> str:
    """Return the name of a callable, with its module if it belongs to a library."""
    if not hasattr(value, "__qualname__"):
        return repr(value)
    module = getattr(value, "__module__", None)
    if is_own(value):
        return f"ctxval.{value.__qualname__}"
    return f"{module}.{value.__qualname__}" if module and is_library(value) else str(value.__qualname__)


def _describe_array(array: np.ndarray[Any, Any]) -> Any:
    if array.dtype.kind not in "biuf":
        items = array.ravel().tolist()
        return [item if isinstance(item, str) else re.sub(r" at 0x[0-9a-f]+", "", repr(item)) for item in items]
    if array.size <= _LISTED:
        return array.tolist()
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        finite = np.nan_to_num(array, nan=0.0, posinf=0.0, neginf=0.0)
        return {"not finite": _describe_array(np.flatnonzero(~np.isfinite(array))), "finite": _describe_array(finite)}
    # The projection differs between arrays that have the same values in another order.
    projection = float(array.ravel() @ np.cos(np.arange(array.size)))
    summary = {"mean": float(array.mean()), "std": float(array.std()), "projection": projection}
    return {"shape": list(array.shape), **summary}


def _attributes(value: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    try:
        return dict(vars(value))
    except TypeError:
        return {}


def rounded(value: Any, digits: int, least: float = 0.0) -> Any:
    """Return a description with its floats rounded, because machines differ in the last digits.

    Args:
        value: the description.
        digits: number of significant digits that are kept.
        least: magnitude up to which a float becomes 0.
    """
    if isinstance(value, float):
        return "0" if abs(value) <= least else f"{value:.{digits}g}"
    if isinstance(value, dict):
        return {key: rounded(item, digits, least) for key, item in value.items()}
    return [rounded(item, digits, least) for item in value] if isinstance(value, list) else value


def first_difference(stored: Any, present: Any, path: str = "") -> str | None:
    """Return a sentence about the first difference of two descriptions. Returns None if they agree.

    Floats agree within a relative 1e-6, so that a model fitted again on another machine is the same model. The name of
    a function does not matter if the function has a digest.
    """
    return next((sentence for _, sentence in differences(stored, present, path)), None)


def differences(stored: Any, present: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and a sentence for each difference of two descriptions; see :func:`first_difference`."""
    if isinstance(stored, dict) and isinstance(present, dict):
        for key in [*stored, *(key for key in present if key not in stored)]:
            yield from _at_key(stored, present, key, path)
    elif isinstance(stored, list) and isinstance(present, list) and len(stored) == len(present):
        for i, (a, b) in enumerate(zip(stored, present, strict=True)):
            yield from differences(a, b, f"{path}[{i}]")
    elif not _same(stored, present):
        yield path, f"{path} was {_short(stored)} and is now {_short(present)}"


def _at_key(stored: dict[str, Any], present: dict[str, Any], key: str, path: str) -> Iterator[tuple[str, str]]:
    here = f"{path}.{key}" if path else key
    coded = "digest" in stored and "digest" in present
    if coded and key == "digest":
        if stored[key] != present[key]:
            called = f", {present['function']}," if "function" in present else ""
            yield path, f"the code of {path or 'it'}{called} has changed"
    elif coded and key == "function":
        return
    elif (key in stored) != (key in present):
        yield here, f"{here} is {'missing now' if key in stored else 'new'}"
    else:
        yield from differences(stored[key], present[key], here)


def _same(stored: Any, present: Any) -> bool:
    if isinstance(stored, int | float) and isinstance(present, int | float):
        both_nan = math.isnan(stored) and math.isnan(present)
        return both_nan or math.isclose(stored, present, rel_tol=_TOLERANCE, abs_tol=1e-13)
    return bool(stored == present)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
