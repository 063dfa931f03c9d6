"""What objects show at a prompt: one to five short lines without raw arrays, however large or hostile their content.

Each class has a short ``__repr__`` that says what matters about it; the formatting is here. Nothing of it identifies an
object in a store: that is :mod:`ctxval._util.describe`, and what is shown here is rounded.
"""

from __future__ import annotations

import dataclasses
import html
import inspect
import numbers
import re
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import partial
from itertools import islice
from pathlib import PurePath
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.texts import plain, shortened, visible

LONGEST = 600
"""Characters of one object."""

LINE = 150
"""Characters of one line of several, if all of them are not too long together."""

LINES = 5
"""Lines of one object."""

_CALL = 240
"""Characters of an object that is shown in a single line."""

_VALUE = 90
"""Characters of a value inside an object."""

_NAME = 60
"""Characters of a name: of a class, a field, a parameter, a unit."""

_ITEMS = 6
"""Items of a collection that are shown."""

_DEPTH = 3
"""How deep collections in collections are shown."""

_CELL = 500
"""Characters of one cell of an HTML table."""

_ROWS = 40
"""Rows of an HTML table."""

_UNREADABLE = re.compile(r" at 0x|\barray\(")
"""What a representation has that tells a reader nothing: an address in memory, or raw numbers."""


class Shown(str):
    """A text that is shown as it is, without quotation marks."""

    __slots__ = ()


# Texts


def line(text: object, longest: int = LINE) -> str:
    """Return a text of anybody's as one line: control characters written out, the middle of a long one left out."""
    return shortened(" ".join(visible(plain(text)).split()), longest)


def cut(text: str, longest: int) -> str:
    """Return the beginning of a text that is too long."""
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def lines(head: str, *rows: str) -> str:
    """Return a first line, and indented ones below it."""
    given = [cut(row, LINE) for row in (head, *(f"  {row}" for row in rows[: LINES - 1]))]
    return "\n".join(given if len("\n".join(given)) <= LONGEST else [cut(row, LONGEST // LINES - 1) for row in given])


def call(owner: object, /, *items: object, **fields: object) -> str:
    """Return ``Name(item, field=value)`` in one line; fields that are None are left out."""
    name = owner if isinstance(owner, str) else type(owner).__name__
    inside = [
        *map(shown, items),
        *(f"{line(key, 40)}={shown(value)}" for key, value in fields.items() if value is not None),
    ]
    return cut(f"{line(name, _VALUE)}({', '.join(inside)})", _CALL)


def record(owner: Any) -> str:
    """Return a dataclass with all its fields in one line."""
    return call(owner, **{field.name: getattr(owner, field.name) for field in dataclasses.fields(owner)})


def options(owner: object) -> dict[str, Any]:
    """Return the arguments of the constructor that an object keeps under their own names."""
    kept = getattr(owner, "__dict__", {})
    return {name: kept[name] for name in inspect.signature(type(owner).__init__).parameters if name in kept}


# Values


def shown(value: Any, depth: int = _DEPTH) -> str:
    """Return any value as a short text: numbers to four digits, of arrays and collections the size."""
    if isinstance(value, Shown) or value is None or isinstance(value, bool | np.bool_):
        return str(value)
    if isinstance(value, str | PurePath):
        return _quoted(str(value))
    if isinstance(value, bytes | bytearray | memoryview):
        return f"{len(value)} bytes"
    if isinstance(value, np.ndarray):
        return array(value)
    if isinstance(value, numbers.Number):
        return number(value)
    if isinstance(value, type | partial) or inspect.isroutine(value):
        return name_of(value)
    if isinstance(value, Mapping | Sequence | AbstractSet):
        return _collection(value, depth)
    return _object(value)


def number(value: Any) -> str:
    """Return a number with four significant digits, an integer with all of its own."""
    if isinstance(value, numbers.Integral):
        whole = int(value)
        return str(whole) if whole.bit_length() <= 64 else f"{'-' * (whole < 0)}2**{whole.bit_length() - 1}..."
    try:
        text = f"{value:.4g}"
        return "0" if text == "-0" else text
    except (TypeError, ValueError):
        return cut(str(value), _VALUE)


def array(values: Array) -> Shown:
    """Return a short vector with its numbers, any other array with its shape and its range."""
    if values.ndim == 0:
        return Shown(shown(values.item()))
    if values.ndim == 1 and values.size <= _ITEMS and values.dtype.kind in "biuf":
        return Shown(f"[{', '.join(map(shown, values.tolist()))}]")
    return Shown(f"{values.shape}{within(values)}")


def within(values: Array) -> str:
    """Return the range of an array's finite numbers as `` in [low, high]``; empty if it has no numbers."""
    if values.dtype.kind not in "biuf" or not values.size:
        return ""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return ", not finite"
    low, high = number(finite.min()), number(finite.max())
    rest = "" if finite.size == values.size else ", partly not finite"
    return (f" in [{low}, {high}]" if low != high else f" all {low}") + rest


def weight(matrix: Array) -> Shown:
    """Return a weight matrix, ``diag(...)`` if it is a small diagonal one."""
    diagonal = np.diagonal(matrix)
    if diagonal.size <= _ITEMS and np.array_equal(matrix, np.diag(diagonal)):
        return Shown(f"diag({', '.join(map(number, diagonal.tolist()))})")
    return array(matrix)


def named(values: Mapping[str, Any], units: Mapping[str, str] | None = None) -> Shown:
    """Return values by name with their units, such as ``goal=1.5 rad, offset=[0, 1] m``."""
    known = {} if units is None else units
    items = [
        f"{line(name, _NAME)}={shown(value)}" + (f" {line(unit, _NAME)}" if (unit := known.get(name, "")) else "")
        for name, value in list(values.items())[:_ITEMS]
    ]
    return Shown(", ".join([*items, *_rest(len(values))]))


def counted(count: int, singular: str, plural: str | None = None) -> Shown:
    """Return how many there are, such as ``1 trial`` and ``2 trials``."""
    return Shown(f"{count} {singular if count == 1 else plural or f'{singular}s'}")


def name_of(function: Any) -> Shown:
    """Return the name of a function or a class."""
    if isinstance(function, partial):
        return Shown(f"partial({name_of(function.func)})")
    name = getattr(function, "__qualname__", None)
    return Shown(line(name if isinstance(name, str) else type(function).__name__, _VALUE))


def _quoted(text: str) -> str:
    return cut(visible(repr(shortened(plain(text), _VALUE))), 2 * _VALUE)


def _collection(values: Any, depth: int) -> str:
    if depth == 0:
        return f"{type(values).__name__} of {len(values)}"
    if isinstance(values, Mapping):
        first = [f"{shown(key, depth - 1)}: {shown(values[key], depth - 1)}" for key in _first(values)]
        return cut(f"{{{', '.join([*first, *_rest(len(values))])}}}", 2 * _VALUE)
    first = [shown(item, depth - 1) for item in _first(values)]
    inside = ", ".join([*first, *_rest(len(values))])
    if isinstance(values, list):
        return cut(f"[{inside}]", 2 * _VALUE)
    return cut(f"({inside},)" if len(values) == 1 else f"({inside})", 2 * _VALUE)


def _first(values: Iterable[Any]) -> list[Any]:
    return list(islice(values, _ITEMS))


def _rest(count: int) -> list[str]:
    return [f"... {count - _ITEMS} more"] if count > _ITEMS else []


def _object(value: Any) -> str:
    """Return what an object says of itself in one line; the name of its class if that is nothing readable.

    Of our own objects that is their first line.
    """
    kind: Any = type(value)
    name = name_of(kind)
    if kind.__repr__ is object.__repr__:
        return name
    try:
        text = plain(repr(value))
    except Exception:
        return name
    if _UNREADABLE.search(text):
        return name
    own = str(kind.__module__).partition(".")[0] == __name__.partition(".")[0]
    return cut(line(text.partition("\n")[0] if own else text, 4 * _VALUE), 2 * _VALUE)


# HTML


def table(title: str, rows: Iterable[tuple[str, object]]) -> str:
    """Return a plain HTML table of two columns; rows whose value is None are left out.

    It sets no colours, so that it is legible on light and dark pages. Every text is escaped.
    """
    given = [(name, value) for name, value in rows if value is not None]
    body = "".join(_row(name, value) for name, value in given[:_ROWS])
    if len(given) > _ROWS:
        body += _row("...", Shown(f"{len(given) - _ROWS} more rows"))
    caption = f'<caption style="{_TEXT};font-weight:bold">{_escaped(title)}</caption>'
    return f'<table style="border-collapse:collapse;color:inherit">{caption}<tbody>{body}</tbody></table>'


_TEXT = "text-align:left;color:inherit;background:transparent"
_CSS = f"{_TEXT};vertical-align:top;padding:0.2em 0.8em 0.2em 0.2em;border-bottom:1px solid currentColor"


def _row(name: str, value: object) -> str:
    text = value if isinstance(value, str) else shown(value)
    return f'<tr><th scope="row" style="{_CSS}">{_escaped(name)}</th><td style="{_CSS}">{_escaped(text)}</td></tr>'


def _escaped(text: str) -> str:
    return html.escape(line(text, _CELL), quote=True)
