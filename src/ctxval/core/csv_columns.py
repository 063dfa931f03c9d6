"""The CSV file of one trajectory: named columns of times, states and inputs, with units in brackets."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import EPISODES, column_of, in_seconds, time_column
from ctxval._util.csv_table import CsvTable
from ctxval._util.files import written_whole
from ctxval._util.texts import enumerated, guarded, parted, visible
from ctxval._util.units import conversion, named_unit
from ctxval.errors import InputError, ShapeError


def write_columns(
    path: str | Path,
    times: Array,
    states: Array,
    inputs: Array,
    state_names: Sequence[str] | None,
    input_names: Sequence[str] | None,
) -> None:
    """Write times ``(H + 1,)``, states ``(H + 1, n)`` and inputs ``(H, m)`` as CSV; the last row has no inputs."""
    n, m = states.shape[-1], inputs.shape[-1]
    header = ["t", *_column_names("x", state_names, n), *_column_names("u", input_names, m)]
    with written_whole(path, text=True) as file:
        writer = csv.writer(file)
        writer.writerow([guarded(visible(name)) for name in header])
        for k, (time, state) in enumerate(zip(times.tolist(), states.tolist(), strict=True)):
            row = inputs[k].tolist() if k < len(inputs) else [""] * m
            writer.writerow([time, *state, *row])


def read_columns(
    path: str | Path, states: Sequence[str] | None, inputs: Sequence[str] | None, most_rows: int | None
) -> tuple[Array, Array, Array]:
    """Return times ``(H + 1,)``, states ``(H + 1, n)`` and inputs ``(H, m)``; see :meth:`Trajectory.from_csv`."""
    table = CsvTable(path)
    time = time_column(str(path), table.names)
    x, u = _chosen(table, "x", states), _chosen(table, "u", inputs)
    if any(table.names) and (time is None or not x):
        raise InputError(
            f"{path} must have the columns t, {', '.join(states or ('x0', '...'))}, "
            f"{', '.join(inputs or ('u0', '...'))}; it has {_listed(table.names)}."
        )
    column, unit = time or ("", "s")
    read = table.columns([column, *x, *u], last=list(u), most=most_rows)
    if len(times := read[column]) < 2:
        raise InputError(f"{path} must have a header and at least two rows.")
    if any(len(set(table.texts(name))) > 1 for name in table.names if name in EPISODES and name not in read):
        raise InputError(f"{path} has several recordings, which a column numbers; a file must hold one.")
    seconds = in_seconds(str(path), times, unit or ("s" if column == "t" else ""))
    return seconds, _stacked(read, x, len(times)), _stacked(read, u, len(times))[:-1]


def _stacked(read: dict[str, Array], factors: dict[str, float], count: int) -> Array:
    columns = [factor * read[name] for name, factor in factors.items()]
    return np.stack(columns, axis=-1) if columns else np.empty((count, 0))


def _column_names(letter: str, names: Sequence[str] | None, count: int) -> list[str]:
    if names is None:
        return [f"{letter}{i}" for i in range(count)]
    if len(names) != count:
        raise ShapeError(f"there must be {count} names of columns, got {', '.join(names) or 'none'}.")
    return list(names)


def _listed(names: Sequence[str]) -> str:
    """Return names for a message; long names and long lists are cut."""
    return enumerated((name[:60] for name in names), 20)


def _chosen(table: CsvTable, letter: str, names: Sequence[str] | None) -> dict[str, float]:
    """Return the columns of the states or inputs, each with the factor to its unit; numbered ones if none is named."""
    path, wanted = str(table.path), dict(parted(name) for name in names or ())
    columns = {name: column_of(path, table.names, name) for name in wanted}
    if not any(columns.values()):
        units = {plain: (name, unit) for name in table.names for plain, unit, _ in (named_unit(name),)}
        count = sum(1 for plain in units if plain[:1] == letter and plain[1:].isdigit())
        columns = {f"{letter}{i}": units.get(f"{letter}{i}") for i in range(count)}
        wanted = dict(zip(columns, wanted.values(), strict=False)) if len(wanted) == count else {}
    factors = dict[str, float]()
    for name, column in columns.items():
        if column is None:
            raise InputError(f"{path} has no column {name}; there are {_listed(table.names)}.")
        try:
            factors[column[0]] = conversion(column[1], wanted.get(name) or column[1]) if column[1] else 1.0
        except InputError:
            raise InputError(f"{path} has {name} in {column[1]}, and {wanted[name]} is needed.") from None
    return factors
