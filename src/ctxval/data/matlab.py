"""Logs in MATLAB files, up to version 7.3. Needs pymatreader (extra ``logs``), which reads 7.3 with h5py."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.extras import require_extra
from ctxval._util.files import MOST_BYTES, require_regular_file
from ctxval.data.log import Log, MemoryTable
from ctxval.errors import InputError

_DEPTH = 6
"""Largest depth of structures in structures."""


def read_mat(path: Path) -> list[Log]:
    """Return the log in a MATLAB file: its numeric arrays; ``name.part`` is a field of a structure.

    Raises:
        InputError: if the file cannot be read, or has no numeric array.
    """
    reader = require_extra("pymatreader", "logs", "MATLAB files")
    try:
        require_regular_file(path)
        size = sum(8 * math.prod(shape) for _, shape, _ in reader.whosmat(str(path)))
        if size > MOST_BYTES:
            raise InputError(f"its arrays have {size} bytes, and at most {MOST_BYTES} are read")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of objects of MATLAB's classes, which are not data
            content = reader.read_mat(str(path))
    except InputError as error:
        raise InputError(f"{path} cannot be read as a MATLAB file: {error}.") from error
    except Exception as error:  # damaged files raise many kinds of exceptions
        raise InputError(f"{path} cannot be read as a MATLAB file ({type(error).__name__}: {error}).") from error
    columns = dict(_numeric("", content, _DEPTH))
    if not columns:
        raise InputError(f"{path} has no numeric array.")
    return [MemoryTable(str(path), columns)]


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
        array = np.asarray(value) if isinstance(value, np.ndarray | list | int | float) else np.array("")
        if array.dtype.kind in "biuf" and array.ndim <= 2 and array.size:
            yield path, array.astype(np.float64)
