"""The CSV file of one trajectory: named columns of times, states and inputs, with units in brackets."""

from __future__ import annotations

import csv
import re
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import MOST_BYTES, csv_rows
from ctxval._util.texts import enumerated, guarded, parted, unguarded, visible
from ctxval.errors import InputError, ShapeError


def write_columns(
    path: str | Path,
    times: Array,
    states: Array,
    inputs: Array,
    state_names: Sequence[str] | None,
    input_names: Sequence[str] | None,
) -> None:
    """Write times ``(H + 1,)``, states ``(H + 1, n)`` and inputs ``(H, m)`` as CSV; the last row has no inputs.

    Args:
        path: the file.
        times, states, inputs: the numbers.
        state_names, input_names: the names of the columns; ``x0, x1, ...`` and ``u0, u1, ...`` by default.

    Raises:
        ShapeError: if the number of names differs from that of columns.
    """
    n, m = states.shape[-1], inputs.shape[-1]
    header = ["t", *_column_names("x", state_names, n), *_column_names("u", input_names, m)]
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([guarded(visible(name)) for name in header])
        for k, (time, state) in enumerate(zip(times.tolist(), states.tolist(), strict=True)):
            row = inputs[k].tolist() if k < len(inputs) else [""] * m
            writer.writerow([time, *state, *row])


def read_columns(
    path: str | Path, states: Sequence[str] | None, inputs: Sequence[str] | None, most_rows: int | None
) -> tuple[Array, Array, Array]:
    """Return times ``(H + 1,)``, states ``(H + 1, n)`` and inputs ``(H, m)``; see :meth:`Trajectory.from_csv`.

    Raises:
        InputError: if the file cannot be read, a column is missing or has another unit, or a cell is not a number.
    """
    rows = _csv_rows(path)
    header = [unguarded(name) for name in next(rows, (0, []))[1]]
    columns = {bare: name for name in header if (bare := parted(name)[0])}
    # A column "t" comes first, because a state may be called "time".
    time = columns.get("t") or columns.get("time")
    x, u = _chosen(path, columns, "x", states), _chosen(path, columns, "u", inputs)
    if header and (time is None or not x):
        raise InputError(
            f"{path} must have the columns t, {', '.join(states or ('x0', '...'))}, "
            f"{', '.join(inputs or ('u0', '...'))}; {_found(header)}."
        )
    return _Columns(path, header, [time or "", *x], u).read(rows, most_rows)


def _found(header: Sequence[str]) -> str:
    """Return what is wrong with a header, for a message."""
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and separator in header[0]:
            return f"it has {name} between its columns: use commas, and points in the numbers"
    return f"it has {_listed(header)}"


def _column_names(letter: str, names: Sequence[str] | None, count: int) -> list[str]:
    if names is None:
        return [f"{letter}{i}" for i in range(count)]
    if len(names) != count:
        raise ShapeError(f"there must be {count} names of columns, got {', '.join(names) or 'none'}.")
    return list(names)


def _csv_rows(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    try:
        yield from csv_rows(path)
    except InputError as error:
        raise InputError(f"{path} cannot be read as CSV: {error}.") from error


class _Columns:
    """The selected columns of a CSV file, read row by row as numbers.

    Args:
        path: the file, for messages.
        header: the names of all columns.
        always: the names of the columns that have a number in every row.
        held: the names of the columns that may have no number in the last row.
    """

    def __init__(self, path: str | Path, header: list[str], always: list[str], held: list[str]) -> None:
        self.path, self.always, self.held = path, always, held
        self.places = {name: place for place, name in enumerate(header)}

    def read(self, rows: Iterator[tuple[int, list[str]]], most: int | None) -> tuple[Array, Array, Array]:
        always, held, count = array("d"), array("d"), 0
        before: tuple[int, list[str]] | None = None
        for line, row in rows:
            if before is not None:
                held.extend(self._numbers(*before, self.held))
            always.extend(self._numbers(line, row, self.always))
            before, count = (line, row), count + 1
            if most is not None and count > most:
                raise InputError(f"{self.path} must have {most} rows below its header, and has more.")
            if 8 * (len(always) + len(held)) > MOST_BYTES:
                raise InputError(f"{self.path} has too many numbers: {MOST_BYTES} bytes may be read.")
        if count < 2:
            raise InputError(f"{self.path} must have a header and at least two rows.")
        block = np.array(always).reshape(count, -1)
        return block[:, 0], block[:, 1:], np.array(held).reshape(count - 1, len(self.held))

    def _numbers(self, line: int, row: list[str], names: list[str]) -> Iterator[float]:
        for name in names:
            place = self.places[name]
            cell = row[place] if place < len(row) else ""
            try:
                yield float(cell)
            except ValueError:
                shown = f"got {cell[:60]!r}" if cell.strip() else "and the cell is empty"
                raise InputError(f"{self.path}, line {line}: {name} must be a number, {shown}.") from None


def _listed(names: Sequence[str]) -> str:
    """Return names for a message; long names and long lists are cut."""
    return enumerated((name[:60] for name in names), 20)


def _chosen(path: str | Path, columns: dict[str, str], letter: str, names: Sequence[str] | None) -> list[str]:
    """Return which columns are the states, or the inputs."""
    named = [parted(name)[0] for name in names or ()]
    if not any(name in columns for name in named):
        return [columns[name] for name in _numbered_columns(columns, letter)]
    missing = [name for name in named if name not in columns]
    if missing:
        raise InputError(f"{path} has no column {missing[0]}; there are {_listed(list(columns))}.")
    for wanted in names or ():
        _require_unit(path, columns[parted(wanted)[0]], wanted)
    return [columns[name] for name in named]


def _require_unit(path: str | Path, column: str, wanted: str) -> None:
    has, needs = _unit(column), _unit(wanted)
    if has and needs and has != needs:
        raise InputError(
            f"{path} has {parted(column)[0]} in {has}, and {needs} is needed; convert it, or leave the unit out of the "
            "header if only its spelling differs."
        )


def _unit(name: str) -> str:
    """Return the unit of a column without signs of products; empty if it has no unit."""
    return re.sub(r"[\s*·.]", "", parted(name)[1])


def _numbered_columns(columns: dict[str, str], letter: str) -> list[str]:
    found = [name for name in columns if name[0] == letter and name[1:].isdigit()]
    names = [f"{letter}{i}" for i in range(len(found))]
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(f"the column {missing[0]} is missing; there are {_listed(found)}.")
    return names
