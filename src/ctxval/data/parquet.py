"""Logs in Parquet files and LeRobot data sets of versions 2 and 3. Needs pyarrow (extra ``logs``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.extras import require_extra
from ctxval._util.files import MOST_BYTES, read_json, require_regular_file
from ctxval.data.log import Log, Table
from ctxval.errors import InputError

STATE, ACTION, EPISODE = "observation.state", "action", "episode_index"
"""Columns of LeRobot data sets, https://github.com/huggingface/lerobot."""


class _File:
    """The columns of one Parquet file, each of which is read when it is needed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        library = require_extra("pyarrow.parquet", "logs", "Parquet files")
        try:
            require_regular_file(path)
            self._file = library.ParquetFile(path)
        except InputError as error:
            raise InputError(f"{path} cannot be read as Parquet: {error}.") from error
        except Exception as error:  # pyarrow raises many kinds
            raise InputError(f"{path} cannot be read as Parquet ({_first_line(error)}).") from error
        self.names: tuple[str, ...] = tuple(self._file.schema_arrow.names)
        self._read: dict[str, Array] = {}

    def column(self, name: str) -> Array:
        """Return a column, ``(N,)`` or ``(N, k)``; a missing value is NaN."""
        if name not in self._read:
            self._read[name] = self._column(name)
        return self._read[name]

    def _column(self, name: str) -> Array:
        compute = require_extra("pyarrow.compute", "logs", "Parquet files")
        sizes = [
            self._file.metadata.row_group(group).column(index).total_uncompressed_size
            for group in range(self._file.metadata.num_row_groups)
            for index in range(self._file.metadata.num_columns)
            if self._file.metadata.row_group(group).column(index).path_in_schema.partition(".")[0] == name
        ]
        if max(sum(sizes), 8 * self._file.metadata.num_rows) > MOST_BYTES:
            raise InputError(f"{self.path}: {name} is too large: {MOST_BYTES} bytes may be read.")
        try:
            column = self._file.read(columns=[name]).column(name).combine_chunks()
            kind = str(column.type)
            if "list" not in kind:
                return np.asarray(column.cast("float64").to_numpy(zero_copy_only=False))
            lengths = np.unique(compute.list_value_length(column).to_numpy(zero_copy_only=False))
            if len(lengths) != 1 or not np.isfinite(lengths[0]):
                raise InputError(f"{self.path}: the vectors of {name} must have one length, got {lengths.tolist()}.")
            values = compute.list_flatten(column).cast("float64").to_numpy(zero_copy_only=False)
            return np.asarray(values.reshape(len(column), int(lengths[0])))
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{self.path}: {name} does not hold numbers ({_first_line(error)}).") from error


class ParquetTable(Table):
    """Some rows of a Parquet file.

    Args:
        source: the file and the episode, for messages.
        file: the file.
        rows: the rows; all rows by default.
        period: seconds between two rows, if it is known.
    """

    def __init__(self, source: str, file: _File, rows: slice = slice(None), period: float | None = None) -> None:
        self.source, self._file, self._rows, self._period = source, file, rows, period
        self.first = rows.start or 0

    @property
    def period(self) -> float | None:
        """Seconds between two rows, if the data set states it."""
        return self._period

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return self._file.names

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return the rows of columns."""
        return {name: self._file.column(name)[self._rows] for name in names}


def read_parquet(path: Path) -> list[Log]:
    """Return the logs in a Parquet file: one for each ``episode_index`` if it has this column, and else one."""
    return list(_episodes(path, _File(path), None))


def read_lerobot(path: Path) -> list[Log]:
    """Return the episodes of a LeRobot data set, a folder with ``meta/info.json`` and ``data/chunk-*/*.parquet``.

    Raises:
        InputError: if the folder is not such a data set, or a file cannot be read.
    """
    info = path / "meta" / "info.json"
    try:
        about = read_json(info)
    except InputError as error:
        raise InputError(f"{info} cannot be read: {error}.") from error
    fps = about.get("fps") if isinstance(about, Mapping) else None
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < float("inf"):
        raise InputError(f"{info}: fps must be a positive number, got {str(fps)[:40]}.")
    files = sorted(path.glob("data/*/*.parquet"))
    if not files:
        raise InputError(f"{path} has no file data/chunk-*/*.parquet.")
    return [log for file in files for log in _episodes(file, _File(file), 1 / fps)]


def lerobot_names(path: Path) -> Mapping[str, list[str]]:
    """Return the names of the components of states and actions that a LeRobot data set states, if it states them."""
    features: Any = read_json(path / "meta" / "info.json").get("features", {})
    found = {}
    for column in (STATE, ACTION):
        names = features.get(column, {}).get("names")
        while isinstance(names, Mapping):  # version 2.0 has a level such as "motors"
            names = next(iter(names.values()), None)
        if isinstance(names, list) and len(set(map(str, names))) == len(names):
            found[column] = [str(name) for name in names]
    return found


def _episodes(path: Path, file: _File, period: float | None) -> list[Log]:
    if EPISODE not in file.names:
        return [ParquetTable(str(path), file, period=period)]
    numbers = file.column(EPISODE)
    starts = np.flatnonzero(np.diff(numbers, prepend=np.nan) != 0)
    ends = [*starts[1:], len(numbers)]
    return [
        ParquetTable(f"{path}, episode {numbers[start]:g}", file, slice(int(start), int(end)), period)
        for start, end in zip(starts, ends, strict=True)
    ]


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0][:120]}"
