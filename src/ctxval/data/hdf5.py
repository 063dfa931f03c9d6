"""HDF5 files: all numeric arrays after a check of the file, and the demonstrations of robomimic. Needs h5py."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import MOST_BYTES, require_regular_file
from ctxval._util.refusals import require_extra
from ctxval._util.texts import quoted
from ctxval.data.log import Log, MemoryTable, reading
from ctxval.errors import InputError

Test = Callable[[Any], bool]  #: of an identifier of a group or of an array

_MOST = 10_000  # arrays and groups of a file


def read_hdf5(path: Path) -> list[Log]:
    """Return the logs in an HDF5 file: one for each group in ``data``, as robomimic writes them, or one of all arrays.

    A field is the path of an array in the group, with dots, such as ``obs.robot0_joint_pos``. The time step is that of
    the ``control_freq`` in robomimic's ``env_args``; otherwise the mapping states it, or an array is called time.
    """
    library = require_extra("h5py", "logs", "HDF5 files need")
    with reading(path, "HDF5"):
        require_regular_file(path)
        with library.File(path, "r") as file:
            found = hdf5_arrays(library, file.id)
            arrays = {name: np.asarray(library.Dataset(each)[()], dtype=np.float64) for name, each in found.items()}
            period = _period(file)
    episodes: dict[str, dict[str, Array]] = {}
    for name, array in arrays.items():
        parts = name.split(".", 2)
        inside = len(parts) == 3 and parts[0] == "data"
        if 1 <= array.ndim <= 2:
            episodes.setdefault(parts[1] if inside else "", {})[parts[2] if inside else name] = array
    if not episodes:
        raise InputError(f"{path} has no numeric array.")
    runs = sorted(episodes.items(), key=lambda run: (len(run[0]), run[0]))  # demo_2 before demo_10
    logs = [MemoryTable(f"{path}, {name}" if name else str(path), columns) for name, columns in runs]
    for log in logs:
        log.period = period
    return [*logs]


def _period(file: Any) -> float | None:
    """Return the seconds of a step that robomimic states; None if it states none."""
    with suppress(KeyError, TypeError, ValueError, ZeroDivisionError, AttributeError):
        return 1 / float(json.loads(file["data"].attrs["env_args"])["env_kwargs"]["control_freq"])
    return None


def hdf5_arrays(
    h5py: Any, group: Any, is_other: Test = lambda group: False, is_numeric: Test = lambda array: True
) -> dict[str, Any]:
    """Return the identifiers of the numeric arrays in a group by their paths, after all in it is checked.

    Groups that are something else are not entered. No reference is followed.
    """
    # HDF5 lets a file name others, such as any of the user: by links, as the storage of a data set, and as the source
    # of a virtual one. Programs that record write none of these.
    numeric, size = dict[str, Any](), 0
    for count, (name, identifier) in enumerate(_objects(h5py, group, is_other)):
        if count >= _MOST:
            raise InputError(f"it has more than {_MOST} arrays and groups")
        if isinstance(identifier, h5py.h5d.DatasetID) and (least := _size(h5py, name, identifier, is_numeric)):
            size += least
            require_size(size)
            numeric[name] = identifier
    return numeric


def _objects(h5py: Any, group: Any, is_other: Test, before: str = "", depth: int = 6) -> Iterator[tuple[str, Any]]:
    """Yield all data sets and groups in a group by their paths; no link to another place is followed."""
    for name in group:
        text = name.decode(errors="replace")
        if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
            raise InputError(f"{quoted(text)} is a link, which could lead to any file")
        path, identifier = f"{before}.{text}".removeprefix("."), h5py.h5o.open(group, name)
        yield path, identifier
        if isinstance(identifier, h5py.h5g.GroupID) and depth and not is_other(identifier):
            yield from _objects(h5py, identifier, is_other, path, depth - 1)


def _size(h5py: Any, path: str, identifier: Any, is_numeric: Test) -> int:
    """Return how many bytes of numbers a data set declares; 0 if it is no array of numbers. Nothing of it is read."""
    h5d, h5t, h5z = h5py.h5d, h5py.h5t, h5py.h5z
    plan = identifier.get_create_plist()
    if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
        raise InputError(f"the values of {quoted(path)} are in another file")
    shape = identifier.shape  # only now: the shape of a virtual data set may depend on other files
    is_array = identifier.get_type().get_class() in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM) and math.prod(shape) > 0
    if not is_array or sum(extent > 1 for extent in shape) > 2 or not is_numeric(identifier):
        return 0
    # The filters of HDF5 itself; others may be code in a library that a path in the environment names.
    usual = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
    if not usual.issuperset(plan.get_filter(i)[0] for i in range(plan.get_nfilters())):
        raise InputError(f"{quoted(path)} is compressed by a filter that is not a part of HDF5")
    chunk = math.prod(plan.get_chunk()) if plan.get_layout() == h5d.CHUNKED else 0
    return int(8 * max(math.prod(shape), chunk))


def require_size(size: int) -> None:
    """Refuse more bytes than are read of one file."""
    if size > MOST_BYTES:
        raise InputError(f"its arrays have {size} bytes, and at most {MOST_BYTES} are read")
