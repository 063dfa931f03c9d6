"""MATLAB files: numeric arrays of variables and structures, and signals of Simulink.

Files of version 7.3 are HDF5 and need h5py: the extra ``logs``. Nothing in a file is ever run.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import open_regular
from ctxval._util.refusals import require_extra
from ctxval.data.hdf5 import hdf5_arrays, require_size
from ctxval.data.log import Log, MemoryTable, leaves, reading
from ctxval.errors import InputError


def read_mat(path: Path) -> list[Log]:
    """Return the log in a MATLAB file: its numeric arrays; ``name.part`` is a field of a structure."""
    with reading(path, "a MATLAB file"):
        with open_regular(path) as file:
            is_hdf5 = any(file.seek(start) == start and file.read(8) == b"\x89HDF\r\n\x1a\n" for start in (0, 512))
        if is_hdf5:
            content = _version_7_3(path)
        else:
            from scipy.io import loadmat, whosmat  # imported here: loading it takes longer than a command

            require_size(sum(8 * math.prod(shape) for _, shape, _ in whosmat(str(path))))
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
    """Return the numeric arrays of an HDF5 file, after all in it is checked."""
    h5py = require_extra("h5py", "logs", "MATLAB files of version 7.3 need")

    def is_other(group: Any) -> bool:
        return bool(h5py.h5a.exists(group, b"MATLAB_sparse"))

    def is_numeric(array: Any) -> bool:
        return not (h5py.h5a.exists(array, b"MATLAB_empty") or _is_text(h5py, array))

    with h5py.File(path, "r") as file:
        found = hdf5_arrays(h5py, file.id, is_other, is_numeric)
        # MATLAB counts the first index fastest.
        return {
            name: np.squeeze(np.asarray(h5py.Dataset(each)[()], dtype=np.float64)).T for name, each in found.items()
        }


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
