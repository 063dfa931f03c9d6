"""MATLAB files: numeric arrays of variables and structures, and signals of Simulink.

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
from ctxval.data.log import Log, MemoryTable, leaves, reading
from ctxval.errors import InputError

_MOST = 10_000  # variables and fields of a file


def read_mat(path: Path) -> list[Log]:
    """Return the log in a MATLAB file: its numeric arrays; ``name.part`` is a field of a structure."""
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
    labels = [label if labels.count(label) == 1 else f"{label}{k}" for k, label in enumerate(labels, 1)]
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
    """Return the numeric arrays of an HDF5 file, after all in it is checked. No reference is followed."""
    # HDF5 lets a file name others, such as any of the user: by links, as the storage of a data set, and as the source
    # of a virtual one. MATLAB writes none of these.
    h5py = require_extra("h5py", "logs", "MATLAB files of version 7.3 need")
    numeric, size = dict[str, Any](), 0
    with h5py.File(path, "r") as file:
        for count, (name, identifier) in enumerate(_hdf5_objects(h5py, file.id)):
            if count >= _MOST:
                raise InputError(f"it has more than {_MOST} variables and fields")
            if isinstance(identifier, h5py.h5d.DatasetID) and (least := _hdf5_size(h5py, name, identifier)):
                size += least
                _require_size(size)
                numeric[name] = identifier
        return {name: _array(h5py, identifier) for name, identifier in numeric.items()}


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
