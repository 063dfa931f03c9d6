"""The reader of each kind of log, by the suffix of a file or the content of a folder; nothing in a log is ever run.

Parquet files and LeRobot data sets (versions 2 and 3) need pyarrow (extra ``logs``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.csv_table import CsvTable
from ctxval._util.extras import require_extra
from ctxval._util.files import MOST_BYTES, read_bytes, read_json, require_regular_file
from ctxval._util.npz import Archive
from ctxval._util.texts import quoted, reason_of
from ctxval.data.log import Log, MemoryTable, Table, reading
from ctxval.data.matlab import read_mat
from ctxval.data.messages import BagLog, McapLog
from ctxval.errors import InputError


class CsvLog(Table):
    """A CSV file with a header, whose columns may state their units."""

    word = "line"

    def __init__(self, path: Path) -> None:
        self.source, self._table = str(path), CsvTable(path)
        if not any(self._table.names):
            raise InputError(f"{path} must be a table with one name for each column, and has no header.")
        self.first = next((line for line, _ in self._table.rows()), 2)

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(name for name in self._table.names if name)

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return columns; an empty cell is NaN."""
        return self._table.columns(names, missing=names)

    def marks(self, name: str) -> Array:
        """Return the texts in a column."""
        return self._table.texts(name)


class NpzTable(Table):
    """An NPZ file: arrays with one row for each time."""

    def __init__(self, path: Path) -> None:
        self.source = str(path)
        with reading(path, "NPZ"):
            self._archive = Archive(read_bytes(path))

    def names(self) -> tuple[str, ...]:
        """Return the names of the arrays."""
        return self._archive.names

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return arrays of numbers."""
        with reading(self.source, "NPZ"):
            return {name: self._archive.numbers(name) for name in names}


def read_npz(path: Path) -> list[Log]:
    """Return the logs in an NPZ file: one, or one for each trajectory of a batch ``(..., H + 1, n)``."""
    table = NpzTable(path)
    if {"times", "states", "inputs"} <= set(table.names()) and table.columns(["states"])["states"].ndim == 3:
        arrays = table.columns(["times", "states", "inputs"])
        if arrays["inputs"].ndim != 3 or len(arrays["inputs"]) != len(arrays["states"]):
            raise InputError(
                f"{path} cannot be read: states {arrays['states'].shape} and inputs {arrays['inputs'].shape} are not "
                "those of one batch of trajectories, (batch, H + 1, n) and (batch, H, m)."
            )
        return [
            MemoryTable(f"{path}, trajectory {k}", {"times": arrays["times"], "states": states, "inputs": inputs})
            for k, (states, inputs) in enumerate(zip(arrays["states"], arrays["inputs"], strict=True))
        ]
    return [NpzTable(path)]


class ParquetTable(Table):
    """A Parquet file, each column of which is read when it is needed."""

    def __init__(self, path: Path, period: float | None = None) -> None:
        self.source, self.period = str(path), period
        library = require_extra("pyarrow.parquet", "logs", "Parquet files")
        with reading(path, "Parquet"):
            require_regular_file(path)
            self._file = library.ParquetFile(path)
        self._read: dict[str, Array] = {}

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self._file.schema_arrow.names)

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return columns, ``(N,)`` or ``(N, k)``; a missing value is NaN."""
        self._read |= {name: self._column(name) for name in names if name not in self._read}
        return {name: self._read[name] for name in names}

    def _column(self, name: str) -> Array:
        compute = require_extra("pyarrow.compute", "logs", "Parquet files")
        about = self._file.metadata
        groups = map(about.row_group, range(about.num_row_groups))
        parts = [group.column(index) for group in groups for index in range(about.num_columns)]
        size = sum(one.total_uncompressed_size for one in parts if one.path_in_schema.partition(".")[0] == name)
        if max(size, 8 * about.num_rows) > MOST_BYTES:
            raise InputError(f"{self.source}: {name} is too large: {MOST_BYTES} bytes may be read.")
        try:
            column = self._file.read(columns=[name]).column(name).combine_chunks()
            kind = str(column.type)
            if kind.startswith("timestamp"):
                column = column.cast("int64")
            if "list" not in kind:  # integers of nanoseconds since 1970 are rounded
                return np.asarray(column.cast("float64", safe=False).to_numpy(zero_copy_only=False))
            lengths = np.unique(compute.list_value_length(column).to_numpy(zero_copy_only=False))
            if len(lengths) != 1 or not np.isfinite(lengths[0]):
                raise InputError(f"{self.source}: the vectors of {name} must have one length, got {lengths.tolist()}.")
            values = compute.list_flatten(column).cast("float64").to_numpy(zero_copy_only=False)
            return np.asarray(values.reshape(len(column), int(lengths[0])))
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{self.source}: {name} does not hold numbers ({quoted(reason_of(error))}).") from error


def read_lerobot(path: Path) -> list[Log]:
    """Return the episodes of a LeRobot data set, a folder with ``meta/info.json`` and ``data/chunk-*/*.parquet``."""
    info = path / "meta" / "info.json"
    with reading(info):
        about = read_json(info)
    fps = about.get("fps") if isinstance(about, Mapping) else None
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < float("inf"):
        raise InputError(f"{info}: fps must be a positive number, got {quoted(fps)}.")
    files = sorted(path.glob("data/*/*.parquet"))
    if not files:
        raise InputError(f"{path} has no file data/chunk-*/*.parquet.")
    return [ParquetTable(file, 1 / fps) for file in files]


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


READERS: dict[str, Callable[[Path], list[Log]]] = {
    ".csv": lambda path: [CsvLog(path)],
    ".npz": read_npz,
    ".mat": read_mat,
    ".parquet": lambda path: [ParquetTable(path)],
    ".mcap": lambda path: [McapLog(path)],
    ".db3": lambda path: [BagLog(path)],
    ".bag": lambda path: [BagLog(path)],
}
"""The reader of each suffix."""


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
    """Return whether a path can only be a log of a program: no CSV or NPZ file, and no plain folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or is_lerobot(path)
    return path.suffix.lower() in READERS and path.suffix.lower() not in (".csv", ".npz")


def is_lerobot(path: Path) -> bool:
    """Return whether a folder is a LeRobot data set."""
    return (path / "meta" / "info.json").is_file()


def _logs(path: Path) -> list[Log]:
    kinds = (
        f"files must end in {', '.join(READERS)}, and folders must be bags of ROS 2 or LeRobot data sets, or contain "
        "such files"
    )
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return [BagLog(path)]
        if is_lerobot(path):
            return read_lerobot(path)
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in READERS]
        if not files:
            raise InputError(f"the folder {path} has no log: {kinds}.")
        return [log for file in files for log in _logs(file)]
    if not path.exists():
        raise InputError(f"there is no file {path}.")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is not a log that can be read: {kinds}.")
    return reader(path)
