"""Logs in tables of plain numbers: CSV and NPZ files."""

from __future__ import annotations

import itertools
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import MOST_BYTES, csv_rows, read_bytes
from ctxval._util.npz import Archive
from ctxval._util.texts import parted, unguarded
from ctxval.data.log import Log, MemoryTable, Table
from ctxval.errors import InputError

_EMPTY = ("", "nan", "na", "null", "none", "-")
"""Cells that stand for a missing value, in small letters."""


class CsvTable(Table):
    """A CSV file with a header; units in brackets, as in ``angle [rad]``, are no part of a name.

    Args:
        path: the file.

    Raises:
        InputError: if the file cannot be read, has no header, or has two columns of one name.
    """

    word = "line"

    def __init__(self, path: Path) -> None:
        self.source, self._path = str(path), path
        header = [parted(unguarded(name))[0] for name in next(self._rows(), (0, []))[1]]
        named = [name for name in header if name]
        if not named or len(set(named)) != len(named):
            wrong = "no header" if not named else f"two columns {max(named, key=named.count)!r}"
            raise InputError(f"{path} must be a table with one name for each column, and has {wrong}.")
        self._header = header
        self.first = next((line for line, _ in itertools.islice(self._rows(), 1, None)), 2)

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        try:
            yield from csv_rows(self._path)
        except InputError as error:
            raise InputError(f"{self._path} cannot be read as CSV: {error}.") from error

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(name for name in self._header if name)

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return columns; an empty cell is NaN.

        Raises:
            InputError: if a cell is not a number; the message names the line and the column.
        """
        places = {name: self._header.index(name) for name in names}
        found = {name: array("d") for name in names}
        for line, row in itertools.islice(self._rows(), 1, None):
            for name, place in places.items():
                found[name].append(self._number(line, name, row[place] if place < len(row) else ""))
            if 8 * len(names) * (line + 1) > MOST_BYTES:
                raise InputError(f"{self.source} has too many numbers: {MOST_BYTES} bytes may be read.")
        return {name: np.array(column) for name, column in found.items()}

    def _number(self, line: int, name: str, cell: str) -> float:
        try:
            return float(cell)
        except ValueError:
            if cell.strip().lower() in _EMPTY:
                return float("nan")
            shown = repr(cell[:60])
            raise InputError(f"{self.source}, line {line}: {name} must be a number, got {shown}.") from None


class NpzTable(Table):
    """An NPZ file: arrays with one row for each time. Nothing in it is ever run.

    Args:
        path: the file.

    Raises:
        InputError: if the file is not an archive of arrays.
    """

    def __init__(self, path: Path) -> None:
        self.source = str(path)
        try:
            self._archive = Archive(read_bytes(path))
        except InputError as error:
            raise InputError(f"{path} cannot be read as NPZ: {error}.") from error

    def names(self) -> tuple[str, ...]:
        """Return the names of the arrays."""
        return self._archive.names

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return arrays of numbers."""
        try:
            return {name: self._archive.numbers(name) for name in names}
        except InputError as error:
            raise InputError(f"{self.source} cannot be read as NPZ: {error}.") from error


def read_csv(path: Path) -> list[Log]:
    """Return the log in a CSV file."""
    return [CsvTable(path)]


def read_npz(path: Path) -> list[Log]:
    """Return the logs in an NPZ file: one, or one for each trajectory of a batch ``(..., H + 1, n)``."""
    table = NpzTable(path)
    if {"times", "states", "inputs"} <= set(table.names()) and table.columns(["states"])["states"].ndim == 3:
        arrays = NpzTable(path).columns(["times", "states", "inputs"])
        return [
            MemoryTable(f"{path}, trajectory {k}", {"times": arrays["times"], "states": states, "inputs": inputs})
            for k, (states, inputs) in enumerate(zip(arrays["states"], arrays["inputs"], strict=True))
        ]
    return [NpzTable(path)]
