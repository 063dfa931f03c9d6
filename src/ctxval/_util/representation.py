"""What objects show at a prompt: one short line without raw arrays, however large or hostile their content.

A class that inherits :class:`ShortRepr` shows its fields; another one may say in its ``__repr__`` what matters.
Nothing of it identifies an object in a store: that is :mod:`ctxval._util.describe`, and what is shown here is rounded.
"""

from __future__ import annotations

import dataclasses
import inspect
import numbers
import re
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import PurePath
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.texts import plain, quoted, shortened, visible


@dataclass(frozen=True)
class Widths:
    """How many characters of an object are shown."""

    line: int = 150  # a text in a line
    call: int = 300  # an object
    value: int = 90  # a value inside an object
    items: int = 6  # number of items of a collection


WIDTHS = Widths()


class Shown(str):
    """A text that is shown as it is, without quotation marks."""

    __slots__ = ()


def line(text: object, longest: int = WIDTHS.line) -> str:
    """Return a text of anybody's as one line: control characters written out, the middle of a long one left out."""
    return shortened(" ".join(visible(plain(text)).split()), longest)


def cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def call(owner: object, /, *items: object, **fields: object) -> str:
    """Return ``Name(item, field=value)`` in one line; fields that are None are left out."""
    return cut(_called(type(owner).__name__, items, fields), WIDTHS.call)


def _called(name: str, items: Iterable[object], fields: Mapping[str, object]) -> str:
    named = (f"{line(key, 40)}={shown(value)}" for key, value in fields.items() if value is not None)
    return f"{line(name, WIDTHS.value)}({', '.join([*map(shown, items), *named])})"


def fields_of(owner: Any) -> dict[str, Any]:
    """Return the fields of a dataclass, or the public attributes of another object, without those that are empty."""
    if dataclasses.is_dataclass(owner):
        fields = {field.name: getattr(owner, field.name, None) for field in dataclasses.fields(owner) if field.repr}
    else:
        fields = {name: value for name, value in vars(owner).items() if not name.startswith("_")}
    empty = {name for name, value in fields.items() if isinstance(value, str | Sequence | Mapping) and not len(value)}
    return {name: value for name, value in fields.items() if value is not None and name not in empty}


class ShortRepr:
    """A class whose objects show their fields."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__repr__" not in vars(cls):
            cls.__repr__ = cls.__repr__  # type: ignore[method-assign]  # so that a dataclass does not make its own

    def __repr__(self) -> str:
        return call(self, **fields_of(self))


def options(owner: object) -> dict[str, Any]:
    """Return the arguments of the constructor that an object keeps under their own names."""
    kept = getattr(owner, "__dict__", {})
    return {name: kept[name] for name in inspect.signature(type(owner).__init__).parameters if name in kept}


def shown(value: Any, depth: int = 3) -> str:
    """Return any value as a short text: numbers to four digits, of arrays and collections the size."""
    match value:
        case Shown() | None | bool() | np.bool_():
            return str(value)
        case str() | PurePath():
            return cut(visible(repr(shortened(plain(value), WIDTHS.value))), 2 * WIDTHS.value)
        case bytes() | bytearray() | memoryview():
            return f"{len(value)} bytes"
        case np.ndarray():
            return array(value)
        case numbers.Number():
            return number(value)
        case type() | partial():
            return name_of(value)
        case Mapping() | Sequence() | AbstractSet():
            if depth == 0:
                return f"{type(value).__name__} of {len(value)}"
            first = list(islice(value, WIDTHS.items))
            texts, ends = [shown(item, depth - 1) for item in first], "[]" if isinstance(value, list) else "()"
            if isinstance(value, Mapping):
                texts = [f"{key}: {shown(value[name], depth - 1)}" for key, name in zip(texts, first, strict=True)]
                ends = "{}"
            single = "," if ends == "()" and len(value) == 1 else ""
            return cut(f"{ends[0]}{', '.join([*texts, *_rest(len(value))])}{single}{ends[1]}", 2 * WIDTHS.value)
    if inspect.isroutine(value):
        return name_of(value)
    # What an object says of itself; its class if that is nothing readable.
    kind: Any = type(value)
    if kind.__repr__ is object.__repr__:
        return name_of(kind)
    try:
        short = kind.__repr__ is ShortRepr.__repr__
        text = _called(kind.__name__, [], fields_of(value)) if short else plain(repr(value))
    except Exception:
        return name_of(kind)
    if re.search(r" at 0x|\barray\(", text):  # an address in memory, or raw numbers, which tell a reader nothing
        return name_of(kind)
    return cut(line(text, 4 * WIDTHS.value), 2 * WIDTHS.value)


def number(value: Any) -> str:
    """Return a number with four significant digits, an integer with all of its own."""
    if isinstance(value, numbers.Integral):
        whole = int(value)
        return str(whole) if whole.bit_length() <= 64 else f"{'-' * (whole < 0)}2**{whole.bit_length() - 1}..."
    try:
        text = f"{value:.4g}"
        return "0" if text == "-0" else text
    except (TypeError, ValueError):
        return cut(str(value), WIDTHS.value)


def task_text(parameters: Mapping[str, Any]) -> str:
    """Return the parameters of a task in one line."""

    def of(value: Any) -> str:
        if isinstance(value, list):
            return f"[{', '.join(map(of, value))}]"
        return quoted(value) if isinstance(value, str) else number(value)

    return ", ".join(f"{name} = {of(value)}" for name, value in parameters.items())


def array(values: Array) -> Shown:
    if values.ndim == 0:
        return Shown(shown(values.item()))
    if values.ndim == 1 and values.size <= WIDTHS.items and values.dtype.kind in "biuf":
        return Shown(f"[{', '.join(map(shown, values.tolist()))}]")
    if values.ndim == 2 and 0 < len(values) <= WIDTHS.items and values.dtype.kind in "iuf":
        diagonal = np.diagonal(values)
        if diagonal.any() and values.shape[0] == values.shape[1] and np.array_equal(values, np.diag(diagonal)):
            return Shown(f"diag({', '.join(map(number, diagonal.tolist()))})")
    if values.dtype.kind not in "biuf" or not values.size:
        return Shown(str(values.shape))
    finite = values[np.isfinite(values)]
    if not finite.size:
        return Shown(f"{values.shape}, not finite")
    low, high = number(finite.min()), number(finite.max())
    extent = f" in [{low}, {high}]" if low != high else f" all {low}"
    return Shown(f"{values.shape}{extent}{'' if finite.size == values.size else ', partly not finite'}")


def named(values: Mapping[str, Any], units: Mapping[str, str] | None = None) -> Shown:
    """Return values by name with their units, such as ``goal=1.5 rad, offset=[0, 1] m``."""
    items = [
        f"{line(name, 60)}={shown(value)} {line((units or {}).get(name, ''), 60)}".rstrip()
        for name, value in list(values.items())[: WIDTHS.items]
    ]
    return Shown(", ".join([*items, *_rest(len(values))]))


def counted(count: int, singular: str) -> Shown:
    """Return how many there are, such as ``1 trial`` and ``2 trials``."""
    return Shown(f"{count} {singular if count == 1 else f'{singular}s'}")


def name_of(function: Any) -> Shown:
    if isinstance(function, partial):
        return Shown(f"partial({name_of(function.func)})")
    name = getattr(function, "__qualname__", None)
    return Shown(line(name if isinstance(name, str) else type(function).__name__, WIDTHS.value))


def _rest(count: int) -> list[str]:
    return [f"... {count - WIDTHS.items} more"] if count > WIDTHS.items else []
