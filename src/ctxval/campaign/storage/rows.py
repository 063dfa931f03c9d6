"""Conversion of trials and trajectories to rows of tables and back, with checksums."""

from __future__ import annotations

import json
import sys
import zlib
from dataclasses import replace
from operator import index
from typing import Any, Literal, NoReturn, get_args

import numpy as np

from ctxval._util.arrays import as_floats
from ctxval._util.refusals import reworded
from ctxval._util.texts import shortened, text_of
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Origin, State, Trial
from ctxval.core.trial_note import TrialNote
from ctxval.errors import InputError

COLUMNS = "number, origin, state, unit_point, parameters, attempts, executed, distance, failure, seconds, note, because"
"""Columns of a trial, in the order that :func:`read_trial` takes."""

Side = Literal["model", "system"]  #: whose trajectory it is


def row_of(trial: Trial) -> tuple[Any, ...]:
    """Return a trial as the values that SQLite returns of its columns. Raises an InputError if no row can hold it."""
    with reworded(f"trial {trial.number} cannot be stored", TypeError, ValueError, OverflowError, InputError):
        # -0.0 + 0.0 is 0.0, as SQLite stores it.
        distance, seconds = (None if value is None else float(value) + 0.0 for value in (trial.distance, trial.seconds))
        failure, because = (None if text is None else text_of(text) for text in (trial.failure, trial.because))
        row = (
            *(
                int(index(trial.number)),
                str(trial.origin),
                str(trial.state),
                as_json(as_floats("unit_point", trial.unit_point)),
            ),
            *(as_json(trial.parameters), int(index(trial.attempts)), int(trial.executed)),
            *(distance, failure, seconds, as_json(trial.note.to_json() or None), because),
        )
        read_trial(row, checksum_of(row))
    return row


def as_json(value: Any) -> str:
    """Return the JSON text of a value, which :func:`read_json` reads; arrays and scalars of numpy become plain."""

    def plain(item: Any) -> Any:
        if isinstance(item, np.generic | np.ndarray):
            return item.tolist()
        raise TypeError(f"{type(item).__name__} cannot be written as JSON")

    with reworded("a value has no JSON text", TypeError, ValueError, RecursionError):
        text = json.dumps(value, default=plain)
    read_json(text, finite=False)
    return text


def checksum_of(row: tuple[Any, ...]) -> int:
    """Return the checksum of a row of values in the order in which they are stored."""
    return zlib.crc32(repr(row).encode("utf-8", "backslashreplace"))


def read_trial(row: tuple[Any, ...], checksum: Any) -> Trial:
    """Return the trial of a row. Raises an InputError if the row is damaged or its values are not those of a trial."""
    number, origin, state, point, names, attempts, executed, distance, failure, seconds, note, because = row
    if checksum_of(row) != checksum:
        raise InputError("its checksum does not fit")
    unit_point, parameters, notes = read_json(point), read_json(names), read_json(note or "null", finite=False)
    values = parameters.values() if isinstance(parameters, dict) else [None]
    measured = state == "completed"
    rules = (
        ("number", "an integer >= 0", _count(number)),
        ("attempts", "an integer >= 0", _count(attempts)),
        ("executed", "0 or 1", executed in (0, 1)),
        ("state", f"one of {', '.join(get_args(State))}", state in get_args(State)),
        ("origin", f"one of {', '.join(get_args(Origin))}", origin in get_args(Origin)),
        ("unit_point", "numbers from 0 to 1", _numbers(unit_point) and all(0 <= value <= 1 for value in unit_point)),
        ("parameters", "finite numbers or texts", all(isinstance(v, str) or _number(v) or _numbers(v) for v in values)),
        ("distance", "a finite number >= 0", _size(distance) if measured else distance is None),
        ("seconds", "a finite number >= 0", seconds is None or _size(seconds)),
        ("executed", "that of its state", executed if state == "unmeasured" else state != "open" or not executed),
        *((name, "a text", isinstance(t, str | None)) for name, t in (("failure", failure), ("because", because))),
        ("note", "a table", isinstance(notes, dict | None)),
    )
    for name, wanted, holds in rules:
        if not holds:
            got = shortened(repr(dict(zip(COLUMNS.split(", "), row, strict=True))[name]), 100)
            raise InputError(f"its {name} must be {wanted}, got {got}")
    where = np.array(unit_point, dtype=np.float64)
    known = Trial(number, origin, state, where, parameters, attempts, bool(executed), because=because)
    note_of = TrialNote.from_json(notes or {})
    return replace(known, distance=distance, failure=failure, seconds=seconds, note=note_of)


def _count(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value < 2**53


def _size(value: Any) -> bool:
    return isinstance(value, float) and 0 <= value < np.inf


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_number, value))


def follows(trial: Trial, earlier: list[Trial]) -> bool:
    """Return whether a trial has the next number and the same task space as the earlier trials."""
    return trial.number == len(earlier) and (not earlier or trial.unit_point.shape == earlier[0].unit_point.shape)


def read_json(text: Any, *, finite: bool = True) -> Any:
    """Return the value of a JSON text."""

    def refuse(constant: str) -> NoReturn:
        raise InputError(f"{constant} is not a number of JSON.")

    if not isinstance(text, str):
        raise InputError(f"JSON must be text, got {type(text).__name__}.")
    try:
        value = json.loads(text, parse_constant=refuse if finite else None)
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"the text is not JSON: {error}.") from error
    if not _shallow(value, 50):
        raise InputError("JSON must be nested at most 50 times.")
    return value


def _shallow(value: Any, levels: int) -> bool:
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return items is None or (levels > 0 and all(_shallow(item, levels - 1) for item in items))


MOST_CHARACTERS = 2**24  # largest number of characters of a key, and of the JSON text of a value


def pair_of(key: str, value: Any) -> tuple[str, str]:
    """Return a key and its value as the row of a table."""
    with reworded(f"{key} cannot be stored", InputError):
        text = as_json(value)
    if len(text) > MOST_CHARACTERS:
        raise InputError(f"{key} must have at most {MOST_CHARACTERS} characters as JSON to be stored, got {len(text)}.")
    return key, text


def trajectory_row(number: int, side: str, trajectory: Trajectory) -> tuple[int, str, bytes, int]:
    """Return a trajectory as the row of a table. Raises an InputError if it cannot be read back."""
    npz = trajectory.to_npz()
    row = (number, side, npz, checksum_of((number, side, npz)))
    if read_trajectory(*row) is None:
        raise InputError(f"the {side}'s trajectory of trial {number} cannot be stored: it is too large to be read.")
    return row


def read_trajectory(number: int, side: str, npz: Any, checksum: Any) -> Trajectory | None:
    """Return the trajectory of a row; None if it is damaged, or belongs to another trial or side."""
    if checksum_of((number, side, npz)) != checksum or not isinstance(npz, bytes):
        return None
    try:
        return Trajectory.from_npz(npz)
    except (InputError, TypeError, ValueError):
        return None
