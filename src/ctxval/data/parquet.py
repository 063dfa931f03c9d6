"""Logs in Parquet files and LeRobot data sets of versions 2 and 3. Needs pyarrow (extra ``logs``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.extras import require_extra
from ctxval._util.files import MOST_BYTES, read_json, require_regular_file
from ctxval._util.texts import quoted, reason_of
from ctxval.data.log import Log, Table
from ctxval.errors import InputError

STATE, ACTION = "observation.state", "action"
"""Columns of LeRobot data sets, https://github.com/huggingface/lerobot."""


class ParquetTable(Table):
    """A Parquet file, each column of which is read when it is needed."""

    def __init__(self, path: Path, period: float | None = None) -> None:
        self.source, self.period = str(path), period
        library = require_extra("pyarrow.parquet", "logs", "Parquet files")
        try:
            require_regular_file(path)
            self._file = library.ParquetFile(path)
        except InputError as error:
            raise InputError(f"{path} cannot be read as Parquet: {error}.") from error
        except Exception as error:  # pyarrow raises many kinds
            raise InputError(f"{path} cannot be read as Parquet ({quoted(reason_of(error))}).") from error
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
        sizes = [
            self._file.metadata.row_group(group).column(index).total_uncompressed_size
            for group in range(self._file.metadata.num_row_groups)
            for index in range(self._file.metadata.num_columns)
            if self._file.metadata.row_group(group).column(index).path_in_schema.partition(".")[0] == name
        ]
        if max(sum(sizes), 8 * self._file.metadata.num_rows) > MOST_BYTES:
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
    try:
        about = read_json(info)
    except InputError as error:
        raise InputError(f"{info} cannot be read: {error}.") from error
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
    for column in (STATE, ACTION):
        names = features.get(column, {}).get("names")
        while isinstance(names, Mapping):  # version 2.0 has a level such as "motors"
            names = next(iter(names.values()), None)
        if isinstance(names, list) and len(set(map(str, names))) == len(names):
            stated[column] = [str(name) for name in names]
    return stated
