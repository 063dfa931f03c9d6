"""Logs in MATLAB files. Those of version 7.3 are HDF5 and need h5py (extra ``logs``); scipy reads earlier ones."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.extras import require_extra
from ctxval._util.files import MOST_BYTES, open_regular
from ctxval._util.texts import quoted
from ctxval.data.log import Log, MemoryTable, reading
from ctxval.errors import InputError

_DEPTH = 6  # largest depth of structures in structures


def read_mat(path: Path) -> list[Log]:
    """Return the log in a MATLAB file: its numeric arrays; ``name.part`` is a field of a structure.

    References, which cells and arrays of structures consist of, are never followed.
    """
    with reading(path, "a MATLAB file"):
        with open_regular(path) as file:
            is_hdf5 = any(file.seek(start) == start and file.read(8) == b"\x89HDF\r\n\x1a\n" for start in (0, 512))
        columns = _version_7_3(path) if is_hdf5 else _version_5(path)
    if not columns:
        raise InputError(f"{path} has no numeric array.")
    return [MemoryTable(str(path), columns)]


def _version_5(path: Path) -> dict[str, Array]:
    from scipy.io import loadmat, whosmat  # imported here: loading it takes longer than a command

    _require_size(sum(8 * math.prod(shape) for _, shape, _ in whosmat(str(path))))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of objects of MATLAB's classes, which are not data
        return dict(_numeric("", loadmat(str(path), simplify_cells=True), _DEPTH))


def _numeric(before: str, content: Mapping[str, Any], depth: int) -> Iterator[tuple[str, Array]]:
    """Yield the numeric arrays in nested structures, by their paths."""
    for name, value in content.items():
        path = f"{before}.{name}".removeprefix(".")
        if str(name).startswith("__"):
            continue  # what the reader says of the file
        if isinstance(value, Mapping):
            if depth:
                yield from _numeric(path, value, depth - 1)
            continue
        array = np.asarray(value) if isinstance(value, np.ndarray | int | float) else np.array("")
        if array.dtype.kind in "biuf" and array.ndim <= 2 and array.size:
            yield path, array.astype(np.float64)


def _version_7_3(path: Path) -> dict[str, Array]:
    """Return the numeric arrays of an HDF5 file, after everything in it is checked.

    HDF5 lets a file name others: by links, as the storage of a data set, and as the source of a virtual one. A
    stranger's file would name any file of the user. MATLAB writes none of these.
    """
    h5py = require_extra("h5py", "logs", "MATLAB files of version 7.3")
    with h5py.File(path, "r") as file:
        checked = _Checked(h5py)
        checked.group("", file.id, _DEPTH)
        arrays = {name: h5py.Dataset(identifier)[()] for name, identifier in checked.arrays.items()}
    # MATLAB counts the first index fastest.
    return {name: np.squeeze(np.asarray(values, dtype=np.float64)).T for name, values in arrays.items()}


class _Checked:
    """The numeric arrays of an HDF5 file by their paths, before anything of them is read.

    A file that leads to another one, or declares more than may be read, is refused.
    """

    def __init__(self, h5py: Any) -> None:
        self.h5py, self.size, self.objects = h5py, 0, 0
        self.arrays: dict[str, Any] = {}

    def group(self, before: str, group: Any, depth: int) -> None:
        for name in group:  # the names of the links, none of which is followed here
            self.objects += 1
            if self.objects > 10_000:
                raise InputError("it has more than 10000 variables and fields")
            if group.links.get_info(name).type != self.h5py.h5l.TYPE_HARD:
                raise InputError(f"{quoted(name.decode(errors='replace'))} is a link, which could lead to any file")
            path = f"{before}.{name.decode(errors='replace')}".removeprefix(".")
            identifier = self.h5py.h5o.open(group, name)
            if isinstance(identifier, self.h5py.h5d.DatasetID):
                self.dataset(path, identifier)
                continue
            is_group = isinstance(identifier, self.h5py.h5g.GroupID)
            if is_group and depth and not self._has(identifier, b"MATLAB_sparse"):
                self.group(path, identifier, depth - 1)

    def dataset(self, path: str, identifier: Any) -> None:
        h5d, h5z = self.h5py.h5d, self.h5py.h5z
        plan = identifier.get_create_plist()
        if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
            raise InputError(f"the values of {quoted(path)} are in another file")
        shape = identifier.shape  # only now: the shape of a virtual data set may depend on other files
        kind = self.h5py.h5t
        numeric = identifier.get_type().get_class() in (kind.INTEGER, kind.FLOAT, kind.ENUM)
        if not numeric or math.prod(shape) == 0 or self._has(identifier, b"MATLAB_empty") or self._is_text(identifier):
            return
        if sum(extent > 1 for extent in shape) > 2:
            return
        chunk = math.prod(plan.get_chunk()) if plan.get_layout() == h5d.CHUNKED else 0
        self.size += 8 * max(math.prod(shape), chunk)
        _require_size(self.size)
        # The filters that MATLAB uses; others may be code in a library that a path in the environment names.
        usual = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
        if not usual.issuperset(plan.get_filter(i)[0] for i in range(plan.get_nfilters())):
            raise InputError(f"{quoted(path)} is compressed in a way that MATLAB does not use")
        self.arrays[path] = identifier

    def _has(self, identifier: Any, attribute: bytes) -> bool:
        return bool(self.h5py.h5a.exists(identifier, attribute))

    def _is_text(self, identifier: Any) -> bool:
        if not self._has(identifier, b"MATLAB_class"):
            return False
        attribute = self.h5py.h5a.open(identifier, b"MATLAB_class")
        kind = attribute.get_type()
        if kind.get_class() != self.h5py.h5t.STRING or kind.is_variable_str() or attribute.shape not in ((), (1,)):
            raise InputError("its classes must be texts")
        value = np.zeros(attribute.shape, dtype=attribute.dtype)
        attribute.read(value)
        return bool(value.item() == b"char")


def _require_size(size: int) -> None:
    if size > MOST_BYTES:
        raise InputError(f"its arrays have {size} bytes, and at most {MOST_BYTES} are read")
