"""Recordings of dSPACE ControlDesk in MATLAB files: a structure whose signals name their time axes.

The structure has an array ``X`` of time axes, one for each raster, with ``Data`` and perhaps ``Raster`` and ``Unit``,
and an array ``Y`` of signals, with ``Name``, ``Data``, ``Unit`` and ``XIndex``, the number of the time axis from 1 on.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import column_of, in_seconds
from ctxval._util.representation import ShortRepr
from ctxval.data.log import Clock, Log, Signal
from ctxval.errors import InputError

X_FIELDS, Y_FIELDS = ("Data", "Raster", "Unit"), ("Name", "Data", "Unit", "XIndex", "Raster")
"""What is read of the elements of ``X`` and ``Y``."""

_NONE = {"", "-", "1", "[-]", "none", "n/a"}  # what stands in the place of a unit


@dataclass(frozen=True, eq=False)
class Axis(ShortRepr):
    """The times of a raster, shape ``(N,)``, in a unit that may be empty."""

    raster: str
    unit: str
    times: Array


@dataclass(frozen=True, eq=False)
class Measured(ShortRepr):
    """A signal on one of the time axes: its name, its unit, which may be empty, and its numbers."""

    name: str
    unit: str
    axis: int
    values: Array


class ControlDeskLog(Log):
    """A recording whose signals have time axes of their own.

    A field is the last part of a signal's path, such as ``angle`` of ``Model Root/Plant/angle``, or as much of the path
    as distinguishes it from the others; the whole path is a field too.
    """

    def __init__(self, source: str, axes: Sequence[Axis], measured: Sequence[Measured]) -> None:
        self.source, self._axes = source, axes
        whole = _distinct([_plain(one.name) for one in measured], [axes[one.axis].raster for one in measured])
        self._known = dict(zip(_short(whole), measured, strict=True))
        self._whole = dict(zip(whole, measured, strict=True))
        self._times = dict[int, Array]()

    def fields(self) -> tuple[str, ...]:
        """Return the names of the signals."""
        return tuple(self._known)

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        """Return fields over time; see :meth:`Log.signals`."""
        if clock.field is not None:
            raise InputError(
                f"{self.source} is a recording of ControlDesk, whose signals have times of their own: the mapping must "
                f"not name {clock.field!r} as its time."
            )
        return {field: self._signal(field) for field in fields}

    def _signal(self, field: str) -> Signal:
        one, index = self._measured(field), None
        if one is None and (matched := re.fullmatch(r"(.+?)\[(\d{1,6})\]", field)) is not None:
            one, index = self._measured(matched[1]), int(matched[2])
        if one is None:
            raise self.missing(field)
        times = self._times_of(one.axis)
        values = one.values[:, None] if one.values.ndim == 1 else one.values
        if len(values) != len(times) and values.shape[1] == len(times):
            values = values.T
        if len(values) != len(times):
            raise InputError(
                f"{self.source}: {field} must have {len(times)} values, as its times X({one.axis + 1}) have, got "
                f"{one.values.shape}."
            )
        if index is not None and index >= values.shape[1]:
            raise InputError(f"{self.source}: {field} has {values.shape[1]} components, so there is no {field}.")
        return Signal(times, values if index is None else values[:, [index]], 0, "sample", one.unit)

    def _measured(self, field: str) -> Measured | None:
        if field in self._whole:
            return self._whole[field]
        column = column_of(self.source, self.fields(), field)
        return None if column is None else self._known[column[0]]

    def _times_of(self, number: int) -> Array:
        """Return the times of an axis in seconds, in one array for all of its signals."""
        if number not in self._times:
            axis = self._axes[number]
            if not np.isfinite(axis.times).all():
                raise InputError(f"{self.source}: the times X({number + 1}) must be finite numbers.")
            self._times[number] = in_seconds(self.source, axis.times, axis.unit)
        return self._times[number]


def is_control_desk(structure: Any) -> bool:
    """Return whether a structure is a recording of ControlDesk: it has times, and signals with names and numbers.

    X and Y are mappings, or lists of them, with arrays of numbers as ``Data`` and texts as ``Name``, ``Unit`` and
    ``Raster``.
    """
    if not isinstance(structure, Mapping):
        return False
    return any(_numbers(x).size for x in _elements(structure, "X")) and bool(_named(structure))


def control_desk_log(source: str, structure: Mapping[str, Any]) -> ControlDeskLog:
    """Return the recording in a structure; see :func:`is_control_desk`."""
    axes = [Axis(_text(x, "Raster"), _text(x, "Unit"), _numbers(x).ravel()) for x in _elements(structure, "X")]
    measured = [
        Measured(_text(y, "Name"), _text(y, "Unit"), _axis_of(source, y, axes), _numbers(y)) for y in _named(structure)
    ]
    return ControlDeskLog(source, axes, measured)


def _named(structure: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [y for y in _elements(structure, "Y") if _text(y, "Name") and _numbers(y).size]


def _elements(structure: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    value = structure.get(name)
    given = [value] if isinstance(value, Mapping) else value
    return [one for one in given if isinstance(one, Mapping)] if isinstance(given, list | np.ndarray) else []


def _text(element: Mapping[str, Any], name: str) -> str:
    value = element.get(name)
    text = value.strip() if isinstance(value, str) else ""
    return "" if name == "Unit" and text.casefold() in _NONE else text


def _numbers(element: Mapping[str, Any]) -> Array:
    value = np.asarray(element.get("Data", ()))
    usable = value.dtype.kind in "biuf" and value.ndim <= 2
    return np.asarray(np.atleast_1d(np.squeeze(value)) if usable else (), dtype=np.float64)


def _axis_of(source: str, element: Mapping[str, Any], axes: Sequence[Axis]) -> int:
    """Return the number of the time axis of a signal, from 0 on: that of its index, or else of its raster."""
    stated = element.get("XIndex")
    if stated is not None and np.size(stated) == 1:
        number = float(np.asarray(stated, dtype=np.float64).item())
        if not number.is_integer() or not 1 <= number <= len(axes):
            raise InputError(
                f"{source}: XIndex of {_text(element, 'Name')} must be a number from 1 to {len(axes)}, got {number:g}."
            )
        return int(number) - 1
    raster = _text(element, "Raster")
    return next((k for k, axis in enumerate(axes) if axis.raster == raster), 0)


def _plain(name: str) -> str:
    """Return the path of a signal without quotes around its parts, and without a mark such as ``{SubArray1}``."""
    return "/".join(part.strip().strip('"').strip() for part in re.sub(r"\s*\{[^}]*\}$", "", name).split("/"))


def _distinct(names: list[str], rasters: list[str]) -> list[str]:
    """Return names that differ: signals that several rasters record begin with their raster, or else with a number."""
    count = Counter(names)
    by_raster = [f"{raster}/{name}" if count[name] > 1 else name for name, raster in zip(names, rasters, strict=True)]
    count = Counter(by_raster)
    return [f"{k + 1}/{name}" if count[name] > 1 else name for k, name in enumerate(by_raster)]


def _short(names: list[str]) -> list[str]:
    """Return the last part of each path; the whole path if another one has the same last part."""
    last = [name.rsplit("/", 1)[-1] or name for name in names]
    count = Counter(last)
    return [end if count[end] == 1 else name for end, name in zip(last, names, strict=True)]
