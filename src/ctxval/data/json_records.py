"""Logs in JSON: a list of records with one number for each field, as many recorders write them, also gzipped."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import MOST_BYTES, read_bytes
from ctxval.data.log import Log, MemoryTable
from ctxval.errors import InputError

_DEPTH = 4  # levels of objects within a record


def read_json_records(path: Path) -> list[Log]:
    """Return the log in a JSON file: a list of records, or an object with one list of records.

    A field of a record is a number, true or false, or a list of numbers; ``name.part`` is one of an object in it. What
    is missing or null in a record is NaN. Numbers beside the list, such as a gain, hold for all records. Files that end
    in ``.gz`` are decompressed.
    """
    packed = read_bytes(path)
    try:
        if path.suffix.lower() == ".gz":
            with gzip.open(path) as file:
                packed = file.read(MOST_BYTES + 1)
            if len(packed) > MOST_BYTES:
                raise InputError(f"{path} has more than {MOST_BYTES} bytes when it is decompressed.")
        content = json.loads(packed.decode("utf-8"))
    except (OSError, EOFError, zlib.error, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON: {error}.") from error
    records = _records(path, content)
    rows = [dict(_numbers("", record, _DEPTH)) for record in records]
    columns = {name: _column([row.get(name) for row in rows]) for name in dict.fromkeys(k for row in rows for k in row)}
    kept = {name: column for name, column in columns.items() if column is not None}
    if not kept:
        raise InputError(f"{path} has no field with numbers in its records.")
    around = content.items() if isinstance(content, Mapping) else ()
    constant = {name: np.full(len(records), float(value)) for name, value in around if isinstance(value, int | float)}
    return [MemoryTable(str(path), {**constant, **kept})]


def _records(path: Path, content: Any) -> list[Mapping[str, Any]]:
    lists = [content] if isinstance(content, list) else []
    if isinstance(content, Mapping):
        lists = [value for value in content.values() if isinstance(value, list) and value]
    tables = [each for each in lists if each and all(isinstance(record, Mapping) for record in each)]
    if len(tables) != 1:
        raise InputError(
            f'{path} must have one list of records, as [{{"t": 0.0, "x": 1.5}}, ...]; it has {len(tables)} such lists.'
        )
    return tables[0]


def _numbers(before: str, record: Mapping[str, Any], depth: int) -> Iterator[tuple[str, Any]]:
    for name, value in record.items():
        path = f"{before}.{name}".removeprefix(".")
        if isinstance(value, Mapping):
            if depth:
                yield from _numbers(path, value, depth - 1)
        elif not isinstance(value, str):
            yield path, value


def _column(values: list[Any]) -> Array | None:
    """Return a field of all records, ``(N,)`` or ``(N, k)``; None if it does not hold numbers."""
    width = next((len(value) for value in values if isinstance(value, list)), None)
    missing = np.nan if width is None else [np.nan] * width
    try:
        return np.array([missing if value is None else value for value in values], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
