"""MATLAB files: numeric arrays of variables and structures, and recordings of dSPACE ControlDesk.

Files of version 7.3 are HDF5 and need h5py: the extra ``logs``. Nothing in a file is ever run. A recording of
ControlDesk is a structure whose signals name their time axes. It has an array ``X`` of time axes, one for each raster,
and an array ``Y`` of signals, of which ``XIndex`` is the number of the time axis from 1 on.
"""

from __future__ import annotations

import math
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import column_of, in_seconds
from ctxval._util.files import MOST_BYTES, open_regular
from ctxval._util.refusals import require_extra
from ctxval._util.texts import quoted
from ctxval.data.log import Clock, Log, MemoryTable, Signal, leaves, reading
from ctxval.errors import InputError

_MOST = 10_000  # variables and fields of a file, elements of an array of structures, and characters of a text

_FIELDS = {"X": ("Data", "Raster", "Unit"), "Y": ("Name", "Data", "Unit", "XIndex", "Raster")}
"""What is read of the elements of ``X`` and ``Y`` of a recording of ControlDesk."""


def read_mat(path: Path) -> list[Log]:
    """Return the log in a MATLAB file: its numeric arrays; ``name.part`` is a field of a structure.

    If structures are recordings of ControlDesk, they are the logs. References are followed only in these, and only to
    objects that are in the file for themselves and were checked.
    """
    with reading(path, "a MATLAB file"):
        with open_regular(path) as file:
            is_hdf5 = any(file.seek(start) == start and file.read(8) == b"\x89HDF\r\n\x1a\n" for start in (0, 512))
        if is_hdf5:
            content = _version_7_3(path)
        else:
            from scipy.io import loadmat, whosmat  # imported here: loading it takes longer than a command

            _require_size(sum(8 * math.prod(shape) for _, shape, _ in whosmat(str(path))))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of objects of MATLAB's classes, which are not data
                content = dict(loadmat(str(path), simplify_cells=True))
        if recordings := {name: value for name, value in content.items() if is_control_desk(value)}:
            sources = {name: f"{path}, {name}" if len(recordings) > 1 else str(path) for name in recordings}
            return [ControlDeskLog(sources[name], structure) for name, structure in recordings.items()]
        content = {name: value for name, value in content.items() if name[:2] != "__"}
        simulink = {name: signals for name, value in content.items() if (signals := _of_simulink(value))}
        content = simulink.popitem()[1] if len(content) == len(simulink) == 1 else {**content, **simulink}
        numbers = (pair for pair in leaves(content) if isinstance(pair[1], np.ndarray | int | float))
        arrays = ((path, np.asarray(value)) for path, value in numbers)
        numeric = ((path, array) for path, array in arrays if array.dtype.kind in "biuf")
        columns = {path: array.astype(np.float64) for path, array in numeric if array.ndim <= 2 and array.size}
    if not columns:
        raise InputError(f"{path} has no numeric array.")
    if len(columns) == 1 and (rows := _timed_rows(*next(iter(columns.items())))):
        columns = rows
    return [MemoryTable(str(path), columns)]


def _of_simulink(value: Any) -> dict[str, Any]:
    """Return the times and the signals, by their labels, of a Structure With Time of Simulink; empty for others."""
    if not isinstance(value, Mapping) or not {"time", "signals"} <= value.keys():
        return {}
    signals = [value["signals"]] if isinstance(value["signals"], Mapping) else np.ravel(value["signals"]).tolist()
    if not all(isinstance(signal, Mapping) and "values" in signal for signal in signals):
        return {}
    labels = [str(signal.get("label") or f"signal{k}") for k, signal in enumerate(signals, 1)]
    labels = _distinct(labels, [f"{label}{k}" for k, label in enumerate(labels, 1)])
    return {"time": value["time"], **{label: each["values"] for label, each in zip(labels, signals, strict=True)}}


def _timed_rows(name: str, array: Array) -> dict[str, Array]:
    """Return the rows of a matrix that a block To File writes, the first of which are the times; empty for others."""
    steps = np.diff(array[0]) if array.ndim == 2 else np.zeros(1)
    if array.ndim != 2 or not 2 <= len(array) < array.shape[1] or not (steps > 0).all():
        return {}
    if name != "ans" and np.ptp(steps) > 1e-3 * steps.mean():  # the block's usual name; else a state may rise
        return {}
    return {"time": array[0], **{f"{name}{k}": row for k, row in enumerate(array[1:], 1)}}


def _version_7_3(path: Path) -> dict[str, Any]:
    """Return the recordings of ControlDesk in an HDF5 file, or its numeric arrays, after all in it is checked."""
    # HDF5 lets a file name others, such as any of the user: by links, as the storage of a data set, and as the source
    # of a virtual one. MATLAB writes none of these.
    h5py = require_extra("h5py", "logs", "MATLAB files of version 7.3 need")
    checked, numeric, size = dict[str, Any](), list[str](), 0
    with h5py.File(path, "r") as file:
        for count, (name, identifier) in enumerate(_hdf5_objects(h5py, file.id)):
            if count >= _MOST:
                raise InputError(f"it has more than {_MOST} variables and fields")
            if isinstance(identifier, h5py.h5d.DatasetID):
                checked[name] = identifier
                if least := _hdf5_size(h5py, name, identifier):
                    size += least
                    _require_size(size)
                    numeric.append(name)
        recordings: dict[str, Any] = {}
        for variable in dict.fromkeys(name.partition(".")[0] for name in checked):
            parts = {part: _hdf5_elements(h5py, file, checked, f"{variable}.{part}") for part in _FIELDS}
            if is_control_desk(parts):
                recordings[variable] = parts
        return recordings or {name: _array(h5py, checked[name]) for name in numeric}


def _hdf5_elements(h5py: Any, file: Any, checked: Mapping[str, Any], path: str) -> list[dict[str, Any]]:
    """Return the texts and numbers of a structure or an array of structures; empty if none has ``Data``."""
    names = _FIELDS[path.rpartition(".")[2]]
    fields = {name: checked[f"{path}.{name}"] for name in names if f"{path}.{name}" in checked}
    if "Data" not in fields:
        return []
    # The fields of an array of structures are arrays of references to objects in the group `#refs#`.
    references = {name: item for name, item in fields.items() if item.get_type().get_class() == h5py.h5t.REFERENCE}
    if not references:
        return [{name: _value(h5py, item) for name, item in fields.items()}]
    by_address = {h5py.h5o.get_info(item).addr: item for item in checked.values()}
    columns = {}
    for name, item in references.items():
        if not item.get_type().equal(h5py.h5t.STD_REF_OBJ) or math.prod(item.shape) > _MOST:
            return []
        # What was not checked, such as a structure in the place of numbers, has no value.
        read = h5py.Dataset(item)[()].ravel()
        opened = [reference and h5py.h5r.dereference(reference, file.id) for reference in read]
        targets = [by_address.get(h5py.h5o.get_info(place).addr) if place else None for place in opened]
        columns[name] = [np.zeros(0) if target is None else _value(h5py, target) for target in targets]
    if len({len(column) for column in columns.values()}) > 1:
        return []  # cells in one structure
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _value(h5py: Any, item: Any) -> Any:
    """Return a text, or an array of numbers, which is empty for anything else."""
    if _is_text(h5py, item):
        if h5py.h5a.exists(item, b"MATLAB_empty") or math.prod(item.shape) > _MOST:
            return ""
        return "".join(map(chr, np.asarray(h5py.Dataset(item)[()], dtype=np.uint16).ravel().tolist()))
    return _array(h5py, item) if _hdf5_size(h5py, "", item) else np.zeros(0)


def _array(h5py: Any, item: Any) -> Array:
    return np.squeeze(np.asarray(h5py.Dataset(item)[()], dtype=np.float64)).T  # MATLAB counts the first index fastest


def _hdf5_objects(h5py: Any, group: Any, before: str = "", depth: int = 6) -> Iterator[tuple[str, Any]]:
    """Yield all data sets and groups in a group by their paths; no link to another place is followed."""
    for name in group:
        text = name.decode(errors="replace")
        if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
            raise InputError(f"{quoted(text)} is a link, which could lead to any file")
        path, identifier = f"{before}.{text}".removeprefix("."), h5py.h5o.open(group, name)
        yield path, identifier
        is_group = isinstance(identifier, h5py.h5g.GroupID)
        if is_group and depth and not h5py.h5a.exists(identifier, b"MATLAB_sparse"):
            yield from _hdf5_objects(h5py, identifier, path, depth - 1)


def _hdf5_size(h5py: Any, path: str, identifier: Any) -> int:
    """Return how many bytes of numbers a data set declares; 0 if it is no array of numbers. Nothing of it is read."""
    h5d, h5t, h5z = h5py.h5d, h5py.h5t, h5py.h5z
    plan = identifier.get_create_plist()
    if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
        raise InputError(f"the values of {quoted(path)} are in another file")
    shape = identifier.shape  # only now: the shape of a virtual data set may depend on other files
    is_array = identifier.get_type().get_class() in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM) and math.prod(shape) > 0
    is_empty = not is_array or h5py.h5a.exists(identifier, b"MATLAB_empty") or _is_text(h5py, identifier)
    if is_empty or sum(extent > 1 for extent in shape) > 2:
        return 0
    # The filters that MATLAB uses; others may be code in a library that a path in the environment names.
    usual = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
    if not usual.issuperset(plan.get_filter(i)[0] for i in range(plan.get_nfilters())):
        raise InputError(f"{quoted(path)} is compressed in a way that MATLAB does not use")
    chunk = math.prod(plan.get_chunk()) if plan.get_layout() == h5d.CHUNKED else 0
    return int(8 * max(math.prod(shape), chunk))


def _is_text(h5py: Any, identifier: Any) -> bool:
    if not h5py.h5a.exists(identifier, b"MATLAB_class"):
        return False
    attribute = h5py.h5a.open(identifier, b"MATLAB_class")
    kind = attribute.get_type()
    if kind.get_class() != h5py.h5t.STRING or kind.is_variable_str() or attribute.shape not in ((), (1,)):
        raise InputError("its classes must be texts")
    value = np.zeros(attribute.shape, dtype=attribute.dtype)
    attribute.read(value)
    return bool(value.item() == b"char")


def _require_size(size: int) -> None:
    if size > MOST_BYTES:
        raise InputError(f"its arrays have {size} bytes, and at most {MOST_BYTES} are read")


# Recordings of ControlDesk

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
            why = "whose signals have times of their own: the mapping must not name"
            raise InputError(f"{self.source} is a recording of ControlDesk, {why} {clock.field!r} as its time.")
        located = {field: self._located(field, self._signal) for field in fields}
        times = {axis: self._times(axis) for (_, axis), _ in located.values()}
        signals = {}
        for field, ((element, axis), index) in located.items():
            values, rows = _numbers(element), len(times[axis])
            array = values[:, None] if values.ndim == 1 else values
            array = array if len(array) == rows else array.T
            if len(array) != rows:
                wanted = f"{rows} values, as its times X({axis + 1}) have"
                raise InputError(f"{self.source}: {field} must have {wanted}, got {values.shape}.")
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
    """Return whether a structure is a recording of ControlDesk: it has times, and signals with names and numbers."""
    is_mapping = isinstance(structure, Mapping)
    return is_mapping and any(_numbers(x).size for x in _elements(structure, "X")) and bool(_named(structure))


def _named(structure: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [y for y in _elements(structure, "Y") if _text(y, "Name") and _numbers(y).size]


def _elements(structure: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    """Return X or Y, a mapping or a list of them: numbers as ``Data``, texts as ``Name``, ``Unit`` and ``Raster``."""
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
            wanted = f"a number from 1 to {len(rasters)}"
            raise InputError(f"{source}: XIndex of {_text(element, 'Name')} must be {wanted}, got {number:g}.")
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
