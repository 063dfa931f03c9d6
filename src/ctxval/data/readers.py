"""The reader of each kind of log, by the suffix of a file or the content of a folder; nothing in a log is ever run.

MATLAB files of version 7.3 (HDF5) need h5py, and Parquet files and LeRobot data sets (versions 2 and 3) need pyarrow:
the extra ``logs``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.csv_table import CsvTable
from ctxval._util.extras import require_extra
from ctxval._util.files import MOST_BYTES, open_regular, read_bytes, read_json, require_regular_file
from ctxval._util.npz import Archive
from ctxval._util.texts import quoted, reason_of
from ctxval.data.json_records import read_json_records
from ctxval.data.log import Log, MemoryTable, Table, reading
from ctxval.data.messages import BagLog, McapLog
from ctxval.errors import InputError


def read_csv(path: Path) -> list[Log]:
    """Return the log in a CSV file with a header, whose columns may state their units; an empty cell is NaN."""
    table = CsvTable(path)
    names = tuple(filter(None, table.names))
    if not names:
        raise InputError(f"{path} must be a table with one name for each column, and has no header.")
    first = next((line for line, _ in table.rows()), 2)

    def columns(wanted: Sequence[str]) -> dict[str, Array]:
        return table.columns(wanted, missing=wanted)

    return [Table(str(path), names, columns, word="line", first=first, marks=table.texts)]


def read_npz(path: Path) -> list[Log]:
    """Return the logs in an NPZ file: one, or one for each trajectory of a batch ``(..., H + 1, n)``."""
    with reading(path, "NPZ"):
        archive = Archive(read_bytes(path))

    def columns(wanted: Sequence[str]) -> dict[str, Array]:
        with reading(path, "NPZ"):
            return {name: archive.numbers(name) for name in wanted}

    batch = {"times", "states", "inputs"} <= set(archive.names)
    if not batch or columns(["states"])["states"].ndim != 3:
        return [Table(str(path), archive.names, columns)]
    times, states, inputs = columns(["times", "states", "inputs"]).values()
    if inputs.ndim != 3 or len(inputs) != len(states):
        raise InputError(
            f"{path} cannot be read: states {states.shape} and inputs {inputs.shape} are not those of one batch of "
            "trajectories, (batch, H + 1, n) and (batch, H, m)."
        )
    return [
        MemoryTable(f"{path}, trajectory {k}", {"times": times, "states": x, "inputs": u})
        for k, (x, u) in enumerate(zip(states, inputs, strict=True))
    ]


# MATLAB


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
        return dict(_numeric("", loadmat(str(path), simplify_cells=True), 6))


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
    numeric, size = dict[str, Any](), 0
    with h5py.File(path, "r") as file:
        for count, (name, identifier) in enumerate(_hdf5_objects(h5py, file.id)):
            if count >= 10_000:
                raise InputError("it has more than 10000 variables and fields")
            if isinstance(identifier, h5py.h5d.DatasetID) and (least := _hdf5_size(h5py, name, identifier)):
                size += least
                _require_size(size)
                numeric[name] = identifier
        arrays = {name: np.asarray(h5py.Dataset(item)[()], dtype=np.float64) for name, item in numeric.items()}
    return {name: np.squeeze(array).T for name, array in arrays.items()}  # MATLAB counts the first index fastest


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
    if identifier.get_type().get_class() not in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM) or math.prod(shape) == 0:
        return 0
    if h5py.h5a.exists(identifier, b"MATLAB_empty") or _is_text(h5py, identifier):
        return 0
    if sum(extent > 1 for extent in shape) > 2:
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


# Parquet


def read_parquet(path: Path, period: float | None = None) -> list[Log]:
    """Return the log in a Parquet file, each column of which is read when it is needed; a missing value is NaN."""
    library = require_extra("pyarrow.parquet", "logs", "Parquet files")
    with reading(path, "Parquet"):
        require_regular_file(path)
        file = library.ParquetFile(path)

    def columns(wanted: Sequence[str]) -> dict[str, Array]:
        return {name: _parquet_column(path, file, name) for name in wanted}

    return [Table(str(path), file.schema_arrow.names, columns, period=period)]


def _parquet_column(path: Path, file: Any, name: str) -> Array:
    """Return a column, ``(N,)`` or ``(N, k)``."""
    compute = require_extra("pyarrow.compute", "logs", "Parquet files")
    about = file.metadata
    groups = map(about.row_group, range(about.num_row_groups))
    parts = [group.column(index) for group in groups for index in range(about.num_columns)]
    size = sum(part.total_uncompressed_size for part in parts if part.path_in_schema.partition(".")[0] == name)
    if max(size, 8 * about.num_rows) > MOST_BYTES:
        raise InputError(f"{path}: {name} is too large: {MOST_BYTES} bytes may be read.")
    try:
        column = file.read(columns=[name]).column(name).combine_chunks()
        kind = str(column.type)
        if kind.startswith("timestamp"):
            column = column.cast("int64")
        if "list" not in kind:  # integers of nanoseconds since 1970 are rounded
            return np.asarray(column.cast("float64", safe=False).to_numpy(zero_copy_only=False))
        lengths = np.unique(compute.list_value_length(column).to_numpy(zero_copy_only=False))
        if len(lengths) != 1 or not np.isfinite(lengths[0]):
            raise InputError(f"{path}: the vectors of {name} must have one length, got {lengths.tolist()}.")
        values = compute.list_flatten(column).cast("float64").to_numpy(zero_copy_only=False)
        return np.asarray(values.reshape(len(column), int(lengths[0])))
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: {name} does not hold numbers ({quoted(reason_of(error))}).") from error


def read_lerobot(path: Path) -> list[Log]:
    """Return the episodes of a LeRobot data set, a folder with ``meta/info.json`` and ``data/chunk-*/*.parquet``."""
    info = path / "meta" / "info.json"
    with reading(info):
        about = read_json(info)
    fps = about.get("fps") if isinstance(about, Mapping) else None
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < float("inf"):
        raise InputError(f"{info}: fps must be a positive number, got {quoted(fps)}.")
    logs = [log for file in sorted(path.glob("data/*/*.parquet")) for log in read_parquet(file, 1 / fps)]
    if not logs:
        raise InputError(f"{path} has no file data/chunk-*/*.parquet.")
    return logs


def lerobot_names(path: Path) -> Mapping[str, list[str]]:
    """Return the names of the components of states and actions that a LeRobot data set states, if it states them."""
    features: Any = read_json(path / "meta" / "info.json").get("features", {})
    stated = {}
    for column in ("observation.state", "action"):
        names = features.get(column, {}).get("names")
        while isinstance(names, Mapping):  # version 2.0 has a level such as "motors"
            names = next(iter(names.values()), None)
        if isinstance(names, list) and len(set(map(str, names))) == len(names):
            stated[column] = [str(name) for name in names]
    return stated


# Files and folders

READERS: dict[str, Callable[[Path], list[Log]]] = {
    ".csv": read_csv,
    ".npz": read_npz,
    ".mat": read_mat,
    ".parquet": read_parquet,
    ".mcap": lambda path: [McapLog(path)],
    ".db3": lambda path: [BagLog(path)],
    ".bag": lambda path: [BagLog(path)],
    ".json": read_json_records,
    ".gz": read_json_records,
}
"""The reader of each suffix."""

_READABLE = (
    f"files must end in {', '.join(READERS)}, and folders must be bags of ROS 2 or LeRobot data sets, or contain such "
    "files"
)


def read_logs(paths: Sequence[str | Path]) -> list[Log]:
    """Return the logs in files and folders.

    A folder is a bag of ROS 2 if it has a file ``metadata.yaml``, a LeRobot data set if it has ``meta/info.json``, and
    otherwise all logs in it are read, in the order of their names.
    """
    logs = [log for path in paths for log in _logs(Path(path))]
    if not logs:
        raise InputError("there is no log: give at least one file or folder.")
    return logs


def is_log(path: Path) -> bool:
    """Return whether a path can only be a log of a program: no CSV, NPZ or JSON file, and no plain folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or is_lerobot(path)
    return path.suffix.lower() in READERS and path.suffix.lower() not in (".csv", ".npz", ".json")


def is_lerobot(path: Path) -> bool:
    """Return whether a folder is a LeRobot data set."""
    return (path / "meta" / "info.json").is_file()


def _logs(path: Path) -> list[Log]:
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return [BagLog(path)]
        if is_lerobot(path):
            return read_lerobot(path)
        return [log for file in logs_in(path) for log in _logs(file)]
    if not path.exists():
        raise InputError(f"there is no file {path}.")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is not a log that can be read: {_READABLE}.")
    return reader(path)


def logs_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are logs, in the order of their names."""
    files = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in READERS] if folder.is_dir() else []
    if not files:
        raise InputError(f"the folder {folder} has no log: {_READABLE}.")
    return files


def task_of(path: Path) -> str:
    """Return the name of a log without its endings: the name of its task, if there is one file for each."""
    return path.stem if path.suffix.lower() != ".gz" else Path(path.stem).stem
