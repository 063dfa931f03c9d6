"""Logs in tables of plain numbers: CSV and NPZ files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ctxval._util.arrays import Array
from ctxval._util.csv_table import CsvTable
from ctxval._util.files import read_bytes
from ctxval._util.npz import Archive
from ctxval.data.log import Log, MemoryTable, Table
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
    """An NPZ file: arrays with one row for each time. Nothing in it is ever run."""

    def __init__(self, path: Path) -> None:
        self.source = str(path)
        with self._reading():
            self._archive = Archive(read_bytes(path))

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except InputError as error:
            raise InputError(f"{self.source} cannot be read as NPZ: {error}.") from error

    def names(self) -> tuple[str, ...]:
        """Return the names of the arrays."""
        return self._archive.names

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return arrays of numbers."""
        with self._reading():
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
