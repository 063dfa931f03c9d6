"""MATLAB files: numeric arrays of variables and structures, and recordings of dSPACE ControlDesk.

Files of version 7.3 are HDF5 and need h5py: the extra ``logs``. Nothing in a file is ever run.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import MOST_BYTES, open_regular
from ctxval._util.refusals import require_extra
from ctxval._util.texts import quoted
from ctxval.data.control_desk import X_FIELDS, Y_FIELDS, ControlDeskLog, is_control_desk
from ctxval.data.log import Log, MemoryTable, reading
from ctxval.errors import InputError

_MOST = 10_000  # variables and fields of a file, elements of an array of structures, and characters of a text


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
        columns = dict(_numeric("", content, 6))
    if not columns:
        raise InputError(f"{path} has no numeric array.")
    return [MemoryTable(str(path), columns)]


def _numeric(before: str, content: Mapping[str, Any], depth: int) -> Iterator[tuple[str, Array]]:
    """Yield the numeric arrays in nested structures, by their paths."""
    for name, value in content.items():
        path = f"{before}.{name}".removeprefix(".")
        if str(name).startswith("__"):
            continue  # what the reader says of the file
        match value:
            case {}:
                yield from _numeric(path, value, depth - 1) if depth else ()
            case np.ndarray() | int() | float():
                array = np.asarray(value)
                if array.dtype.kind in "biuf" and array.ndim <= 2 and array.size:
                    yield path, array.astype(np.float64)


def _version_7_3(path: Path) -> dict[str, Any]:
    """Return the recordings of ControlDesk in an HDF5 file, or its numeric arrays, after everything in it is checked.

    HDF5 lets a file name others: by links, as the storage of a data set, and as the source of a virtual one. A
    stranger's file would name any file of the user. MATLAB writes none of these.
    """
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
            parts = {part: _elements(h5py, file, checked, f"{variable}.{part}") for part in _PARTS}
            if is_control_desk(parts):
                recordings[variable] = parts
        return recordings or {name: _array(h5py, checked[name]) for name in numeric}


_PARTS = {"X": X_FIELDS, "Y": Y_FIELDS}


def _elements(h5py: Any, file: Any, checked: Mapping[str, Any], path: str) -> list[dict[str, Any]]:
    """Return the texts and numbers of a structure or an array of structures; empty if none has ``Data``.

    The fields of an array of structures are arrays of references to objects in the group ``#refs#``.
    """
    names = _PARTS[path.rpartition(".")[2]]
    fields = {name: checked[f"{path}.{name}"] for name in names if f"{path}.{name}" in checked}
    if "Data" not in fields:
        return []
    references = {name: item for name, item in fields.items() if item.get_type().get_class() == h5py.h5t.REFERENCE}
    if not references:
        return [{name: _value(h5py, item) for name, item in fields.items()}]
    by_address = {h5py.h5o.get_info(item).addr: item for item in checked.values()}
    columns = {}
    for name, item in references.items():
        if not item.get_type().equal(h5py.h5t.STD_REF_OBJ) or math.prod(item.shape) > _MOST:
            return []
        # What was not checked, such as a structure in the place of numbers, has no value.
        opened = [
            h5py.h5r.dereference(reference, file.id) if reference else None
            for reference in h5py.Dataset(item)[()].ravel()
        ]
        targets = [place and by_address.get(h5py.h5o.get_info(place).addr) for place in opened]
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
