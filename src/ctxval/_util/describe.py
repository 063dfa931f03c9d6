"""Plain descriptions of objects, by which a store recognises the experiment that it belongs to.

A description has the settings of this package's parts. Of users' objects it has the digest of their source and no
value: attributes, closures, globals and defaults may be secrets.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import math
import numbers
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ctxval._util.code_digest import enclosed, is_library, is_own, source_digest
from ctxval._util.representation import cut


def describe(value: Any, depth: int = 6) -> Any:
    """Return the identity of an object as JSON.

    An object of this package has its type and its public values, or the result of its ``describe()``; any other object
    has its type and the digest of its source.
    """
    match value:
        case str() | int() | None:
            return value
        case np.bool_():
            return bool(value)
        case float() | np.number():
            return float(value) if math.isfinite(value) else str(value)
        case numbers.Number() | range():
            return repr(value)
    if depth == 0:
        return type(value).__qualname__
    if isinstance(value, np.ndarray):
        # A large array is data, and what it does is recomputed.
        listed = value.size <= 100 and value.dtype.kind in "biufO"
        return describe(value.tolist(), value.ndim + 1) if listed else {"shape": list(value.shape)}
    if inspect.isroutine(value) or isinstance(value, functools.partial | type):
        name = getattr(value, "__qualname__", type(value).__qualname__)
        known: dict[str, Any] = {}
        if isinstance(value, functools.partial) and is_own(value.func):
            name, known = value.func.__qualname__, {"args": value.args, "keywords": value.keywords}
        elif inspect.ismethod(value) and is_own(value):
            known = {"of": value.__self__}
        elif inspect.isfunction(value) and is_own(value):
            known = dict(zip(value.__code__.co_freevars, enclosed(value), strict=True))
        described = {key: describe(item, depth - 1) for key, item in known.items()}
        return {"function": name, **described, **_source(value)}
    if not is_library(type(value)):
        return {"type": type(value).__qualname__, **_source(value)}
    match value:
        case Mapping():
            return {str(key): describe(item, depth - 1) for key, item in value.items()}
        case set() | frozenset():
            # Sorted, because the order of a set of strings changes from process to process.
            return sorted((describe(item, depth - 1) for item in value), key=repr)
        case [*items]:  # bytes are no sequence here
            return [describe(item, depth - 1) for item in items]
    settings: Mapping[str, Any] = {}
    if is_own(type(value)) and hasattr(type(value), "describe"):
        settings = value.describe()
    elif is_own(type(value)):
        fields = getattr(value, "__dataclass_fields__", None) or getattr(value, "__dict__", {})
        settings = {name: getattr(value, name) for name in fields if not name.startswith("_")}
    return {"type": type(value).__qualname__, **{str(key): describe(item, depth - 1) for key, item in settings.items()}}


def _source(value: Any) -> dict[str, str]:
    digest = source_digest(value)
    return {} if digest is None else {"source": digest}


def plain_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values, dataclasses among them, as they are read from JSON; a number that is not finite is None."""

    def fields(part: Any) -> Any:
        to_json = getattr(part, "to_json", None)
        return to_json() if to_json else {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}

    return dict(json.loads(json.dumps(values, default=fields), parse_constant=lambda _: None))


def without_numbers(description: Any) -> Any:
    """Return a description with its types, texts and digests only, for parts whose numbers were computed."""
    if not isinstance(description, dict):
        return description
    return {key: without_numbers(item) for key, item in description.items() if isinstance(item, str | dict)}


def first_difference(stored: Any, present: Any) -> str | None:
    """Return the first of the differences of two descriptions as a sentence; None if they agree."""
    return next((sentence for _, sentence in differences(stored, present)), None)


def differences(stored: Any, present: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and a sentence for each difference of two descriptions."""
    if isinstance(stored, dict) and isinstance(present, dict):
        sourced = "source" in stored and "source" in present
        for key in [*stored, *(key for key in present if key not in stored)]:
            here = f"{path}.{key}" if path else key
            if sourced and key in ("source", "function"):
                if key == "source" and stored[key] != present[key]:
                    yield path, f"the source of {path or 'it'} has changed"
            elif (key in stored) != (key in present):
                yield here, f"{here} is {'missing now' if key in stored else 'new'}"
            else:
                yield from differences(stored[key], present[key], here)
    elif isinstance(stored, list) and isinstance(present, list) and len(stored) == len(present):
        for i, (a, b) in enumerate(zip(stored, present, strict=True)):
            yield from differences(a, b, f"{path}[{i}]")
    else:
        same = stored == present
        if {type(stored), type(present)} <= {int, float, bool}:
            # Settings that are computed differ by less than 1e-6 on two machines.
            both_nan = math.isnan(stored) and math.isnan(present)
            same = both_nan or math.isclose(stored, present, rel_tol=1e-6, abs_tol=1e-13)
        if not same:
            yield path, f"{path} was {cut(repr(stored), 60)} and is now {cut(repr(present), 60)}"
