"""The reader of each kind of log, by the suffix of a file or the content of a folder; nothing in a log is ever run.

Parquet files and LeRobot data sets (versions 2 and 3) need pyarrow: the extra ``logs``.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import PositiveFloat, require
from ctxval._util.files import MOST_BYTES, Archive, read_bytes, read_json, require_regular_file
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.tables import CsvTable
from ctxval.data.hdf5 import read_hdf5
from ctxval.data.joined import joined_topics, read_dataflash, read_ulog
from ctxval.data.log import Log, MemoryTable, Table, leaves, reading
from ctxval.data.matlab import read_mat
from ctxval.data.messages import BagLog, McapLog
from ctxval.errors import InputError


def read_csv(path: Path) -> list[Log]:
    """Return the log in a CSV file with a header, whose columns may state their units; a missing value is NaN."""
    table = CsvTable(path)
    names = tuple(filter(None, table.names))
    if not names:
        raise InputError(f"{path} must be a table with one name for each column, and has no header.")
    first = next((line for line, _ in table.rows()), 2)
    columns = partial(table.columns, missing=names)
    clock = table.clock_times
    whole = Table(str(path), names, columns, word="line", first=first, marks=table.texts, clock=clock)
    whole.remarks = table.remarks
    return [whole]


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
        given, wanted = f"states {states.shape} and inputs {inputs.shape}", "(batch, H + 1, n) and (batch, H, m)"
        raise InputError(f"{path} cannot be read: {given} are not those of one batch of trajectories, {wanted}.")
    runs = enumerate(zip(states, inputs, strict=True))
    return [MemoryTable(f"{path}, trajectory {k}", {"times": times, "states": x, "inputs": u}) for k, (x, u) in runs]


# Parquet


def read_parquet(path: Path, period: float | None = None) -> list[Log]:
    """Return the log in a Parquet file, each column of which is read when it is needed; a missing value is NaN."""
    library = require_extra("pyarrow.parquet", "logs", "Parquet files need")
    with reading(path, "Parquet"):
        require_regular_file(path)
        file = library.ParquetFile(path)

    def columns(wanted: Sequence[str]) -> dict[str, Array]:
        return {name: _parquet_column(path, file, name) for name in wanted}

    return [Table(str(path), file.schema_arrow.names, columns, period=period)]


def _parquet_column(path: Path, file: Any, name: str) -> Array:
    compute = require_extra("pyarrow.compute", "logs", "Parquet files need")
    about = file.metadata
    groups = map(about.row_group, range(about.num_row_groups))
    parts = [group.column(index) for group in groups for index in range(about.num_columns)]
    size = sum(part.total_uncompressed_size for part in parts if part.path_in_schema.partition(".")[0] == name)
    if max(size, 8 * about.num_rows) > MOST_BYTES:
        raise InputError(f"{path}: {name} is too large: {MOST_BYTES} bytes may be read.")
    with reworded(f"{path}: {name} does not hold numbers"):
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


def read_lerobot(path: Path) -> list[Log]:
    """Return the episodes of a LeRobot data set, a folder with ``meta/info.json`` and ``data/chunk-*/*.parquet``."""
    info = path / "meta" / "info.json"
    with reading(info):
        about = read_json(info)
    fps = about.get("fps") if isinstance(about, Mapping) else None
    period = 1 / require(f"{info}: fps", PositiveFloat, fps)
    logs = [log for file in sorted(path.glob("data/*/*.parquet")) for log in read_parquet(file, period)]
    if not logs:
        raise InputError(f"{path} has no file data/chunk-*/*.parquet.")
    return logs


def component_names(paths: Sequence[str | Path]) -> Mapping[str, list[str]]:
    """Return the names of the components of states and actions, if there is one LeRobot data set that states them."""
    if len(paths) != 1 or not is_lerobot(Path(paths[0])):
        return {}
    stated = {}
    with suppress(InputError, AttributeError, TypeError):  # names are only labels
        features: Any = read_json(Path(paths[0]) / "meta" / "info.json").get("features", {})
        for column in ("observation.state", "action"):
            names = features.get(column, {}).get("names")
            while isinstance(names, Mapping):  # version 2.0 has a level such as "motors"
                names = next(iter(names.values()), None)
            if isinstance(names, list) and len(set(map(str, names))) == len(names):
                stated[column] = [str(name) for name in names]
    return stated


# JSON


def read_json_records(path: Path) -> list[Log]:
    """Return the log in a JSON file: a list of records, or an object with one list of records.

    A field is a number, true or false, or a list of numbers; ``name.part`` is one of an object in a record. What is
    missing or null is NaN. Numbers beside the list, such as a gain, hold for all records.
    """
    packed = read_bytes(path)
    with reworded(f"{path} cannot be read as JSON", OSError, EOFError, zlib.error, ValueError, RecursionError):
        if path.suffix.lower() == ".gz":
            with gzip.open(path) as file:
                packed = file.read(MOST_BYTES + 1)
            if len(packed) > MOST_BYTES:
                raise InputError(f"{path} has more than {MOST_BYTES} bytes when it is decompressed.")
        content = json.loads(packed.decode("utf-8"))
    around = content if isinstance(content, Mapping) else {"": content}
    tables = [each for each in around.values() if each and type(each) is list and {*map(type, each)} == {dict}]
    if len(tables) != 1:
        example = '[{"t": 0.0, "x": 1.5}, ...]'
        raise InputError(f"{path} must have one list of records, as {example}; it has {len(tables)} such lists.")
    numeric = (int, float, list, type(None))
    rows = [{path: value for path, value in leaves(row, depth=4) if isinstance(value, numeric)} for row in tables[0]]
    columns = dict[str, Array]()
    for name in dict.fromkeys(name for row in rows for name in row):
        values = [row.get(name) for row in rows]
        width = next((len(value) for value in values if isinstance(value, list)), None)
        missing = np.nan if width is None else [np.nan] * width
        with suppress(TypeError, ValueError, OverflowError):  # it does not hold numbers
            columns[name] = np.array([missing if value is None else value for value in values], dtype=np.float64)
    if not columns:
        raise InputError(f"{path} has no field with numbers in its records.")
    beside = {name: value for name, value in around.items() if isinstance(value, int | float)}
    constant = {name: np.full(len(rows), float(value)) for name, value in beside.items()}
    return [MemoryTable(str(path), {**constant, **columns})]


# Files and folders

READERS: dict[str, Callable[[Path], list[Log]]] = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".dat", ".lvm"), read_csv),
    ".npz": read_npz,
    ".mat": read_mat,
    ".ulg": read_ulog,
    ".bin": read_dataflash,
    **dict.fromkeys((".hdf5", ".h5"), read_hdf5),
    ".parquet": read_parquet,
    ".mcap": lambda path: [McapLog(path)],
    ".db3": lambda path: [BagLog(path)],
    ".bag": lambda path: [BagLog(path)],
    ".json": read_json_records,
    ".gz": read_json_records,
}
"""The reader of each suffix."""

_FOLDERS = "folders must be bags of ROS 2 or LeRobot data sets, or contain such files"
_READABLE = f"files must end in {', '.join(READERS)}, and {_FOLDERS}"


def read_logs(paths: Sequence[str | Path]) -> list[Log]:
    """Return the logs in files and folders.

    A folder is a bag of ROS 2 if it has a file ``metadata.yaml``, a LeRobot data set if it has ``meta/info.json``, and
    otherwise all logs in it are read, in the order of their names. Files with the topics of one recording are one log.

    Raises:
        InputError: if there is no log.
    """
    logs = [log for path in paths for log in _logs(Path(path))]
    if not logs:
        raise InputError("there is no log: give at least one file or folder.")
    return joined_topics(logs)


def is_log(path: Path) -> bool:
    """Return whether a path can only be a log of a program: no CSV, NPZ or JSON file, and no plain folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or is_lerobot(path)
    return path.suffix.lower() in READERS.keys() - {".csv", ".npz", ".json", ".txt", ".tsv", ".dat"}


def is_lerobot(path: Path) -> bool:
    """Return whether a folder is a LeRobot data set."""
    return (path / "meta" / "info.json").is_file()


def _logs(path: Path) -> list[Log]:
    if (path / "metadata.yaml").is_file():
        return [BagLog(path)]
    if is_lerobot(path):
        return read_lerobot(path)
    if path.is_dir():
        return [log for file in logs_in(path) for log in _logs(file)]
    if not path.exists():
        raise InputError(f"there is no file {path}.")
    if (suffix := path.suffix.lower()) not in READERS:
        raise InputError(f"{path} is not a log that can be read: {_READABLE}.")
    return READERS[suffix](path)


def logs_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are logs, in the order of their names."""
    named = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in READERS] if folder.is_dir() else []
    # Files such as a README.txt lie beside logs.
    files = [file for file in named if file.suffix.lower() not in (".txt", ".dat")] or named
    if not files:
        raise InputError(f"the folder {folder} has no log: {_READABLE}.")
    return files
