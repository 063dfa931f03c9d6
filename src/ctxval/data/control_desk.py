"""Recordings of dSPACE ControlDesk in MATLAB files: a structure whose signals name their time axes.

The structure has an array ``X`` of time axes, one for each raster, with ``Data`` and perhaps ``Raster`` and ``Unit``,
and an array ``Y`` of signals, with ``Name``, ``Data``, ``Unit`` and ``XIndex``, the number of the time axis from 1 on.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import column_of, in_seconds
from ctxval.data.log import Clock, Log, Signal
from ctxval.errors import InputError

X_FIELDS, Y_FIELDS = ("Data", "Raster", "Unit"), ("Name", "Data", "Unit", "XIndex", "Raster")
"""What is read of the elements of ``X`` and ``Y``."""

_NONE = {"", "-", "1", "[-]", "none", "n/a"}  # what stands in the place of a unit


class ControlDeskLog(Log):
    """A recording whose signals have time axes of their own; ``structure`` is one that :func:`is_control_desk` accepts.

    A field is the last part of a signal's path, such as ``angle`` of ``Model Root/Plant/angle``, or as much of the path
    as distinguishes it from the others; the whole path is a field too.
    """

    def __init__(self, source: str, structure: Mapping[str, Any]) -> None:
        self.source, self._axes = source, _elements(structure, "X")
        rasters = [_text(x, "Raster") for x in self._axes]
        signals = [(y, _axis_of(source, y, rasters)) for y in _named(structure)]
        # Signals that several rasters record begin with their raster, or else with a number.
        paths = [_path(_text(y, "Name")) for y, _ in signals]
        on = [rasters[axis] for _, axis in signals]
        paths = _distinct(paths, [f"{raster}/{path}" for raster, path in zip(on, paths, strict=True)])
        paths = _distinct(paths, [f"{number}/{path}" for number, path in enumerate(paths, 1)])
        last = [path.rsplit("/", 1)[-1] or path for path in paths]
        self._known = dict(zip(_distinct(last, paths), signals, strict=True))
        self._whole = dict(zip(paths, signals, strict=True))

    def fields(self) -> tuple[str, ...]:
        return tuple(self._known)

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        if clock.field is not None:
            raise InputError(
                f"{self.source} is a recording of ControlDesk, whose signals have times of their own: the mapping must "
                f"not name {clock.field!r} as its time."
            )
        located = {field: self._located(field, self._signal) for field in fields}
        times = {axis: self._times(axis) for (_, axis), _ in located.values()}
        signals = {}
        for field, ((element, axis), index) in located.items():
            values, rows = _numbers(element), len(times[axis])
            array = values[:, None] if values.ndim == 1 else values
            array = array if len(array) == rows else array.T
            if len(array) != rows:
                raise InputError(
                    f"{self.source}: {field} must have {rows} values, as its times X({axis + 1}) have, got "
                    f"{values.shape}."
                )
            unit = _text(element, "Unit")
            signals[field] = Signal(times[axis], self._component(field, array, index), 0, "sample", unit)
        return signals

    def _signal(self, field: str) -> tuple[Mapping[str, Any], int] | None:
        """Return the element of a signal, and the number of its time axis."""
        if field in self._whole:
            return self._whole[field]
        column = column_of(self.source, self.fields(), field)
        return None if column is None else self._known[column[0]]

    def _times(self, axis: int) -> Array:
        times = _numbers(self._axes[axis]).ravel()
        if not np.isfinite(times).all():
            raise InputError(f"{self.source}: the times X({axis + 1}) must be finite numbers.")
        return in_seconds(self.source, times, _text(self._axes[axis], "Unit"))


def is_control_desk(structure: Any) -> bool:
    """Return whether a structure is a recording of ControlDesk: it has times, and signals with names and numbers.

    X and Y are mappings, or lists of them, with arrays of numbers as ``Data`` and texts as ``Name``, ``Unit`` and
    ``Raster``.
    """
    if not isinstance(structure, Mapping):
        return False
    return any(_numbers(x).size for x in _elements(structure, "X")) and bool(_named(structure))


def _named(structure: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [y for y in _elements(structure, "Y") if _text(y, "Name") and _numbers(y).size]


def _elements(structure: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    value = structure.get(name)
    given = [value] if isinstance(value, Mapping) else value
    return [part for part in given if isinstance(part, Mapping)] if isinstance(given, list | np.ndarray) else []


def _text(element: Mapping[str, Any], name: str) -> str:
    value = element.get(name)
    text = value.strip() if isinstance(value, str) else ""
    return "" if name == "Unit" and text.casefold() in _NONE else text


def _numbers(element: Mapping[str, Any]) -> Array:
    value = np.asarray(element.get("Data", ()))
    usable = value.dtype.kind in "biuf" and value.ndim <= 2
    return np.asarray(np.atleast_1d(np.squeeze(value)) if usable else (), dtype=np.float64)


def _axis_of(source: str, element: Mapping[str, Any], rasters: Sequence[str]) -> int:
    """Return the number of the time axis of a signal, from 0 on: that of its index, or else of its raster."""
    stated = element.get("XIndex")
    if stated is not None and np.size(stated) == 1:
        number = float(np.asarray(stated, dtype=np.float64).item())
        if not number.is_integer() or not 1 <= number <= len(rasters):
            raise InputError(
                f"{source}: XIndex of {_text(element, 'Name')} must be a number from 1 to {len(rasters)}, got "
                f"{number:g}."
            )
        return int(number) - 1
    raster = _text(element, "Raster")
    return rasters.index(raster) if raster in rasters else 0


def _path(name: str) -> str:
    """Return the path of a signal without quotes around its parts, and without a mark such as ``{SubArray1}``."""
    return "/".join(part.strip().strip('"').strip() for part in re.sub(r"\s*\{[^}]*\}$", "", name).split("/"))


def _distinct(names: list[str], longer: list[str]) -> list[str]:
    """Return the names, and the longer ones in the place of those that several signals have."""
    count = Counter(names)
    return [name if count[name] == 1 else other for name, other in zip(names, longer, strict=True)]
