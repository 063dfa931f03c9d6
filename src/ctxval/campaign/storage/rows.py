"""Conversion of trials and trajectories to rows of tables and back, with checksums."""

from __future__ import annotations

import json
import sys
import zlib
from dataclasses import replace
from typing import Any, Literal, NoReturn, get_args

import numpy as np

from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Origin, State, Trial
from ctxval.errors import InputError

COLUMNS = "number, origin, state, unit_point, parameters, attempts, executed, distance, failure, seconds, note, because"
"""Columns of a trial, in the order that :func:`read_trial` takes."""

Side = Literal["model", "system"]  #: whose trajectory it is


def row_of(trial: Trial) -> tuple[Any, ...]:
    """Return a trial as the values of its columns."""
    # SQLite returns floats, which the checksum must be of.
    distance, seconds = (None if value is None else float(value) for value in (trial.distance, trial.seconds))
    return (
        *(trial.number, trial.origin, trial.state, json.dumps(trial.unit_point.tolist())),
        *(json.dumps(trial.parameters), trial.attempts, int(trial.executed)),
        *(distance, trial.failure, seconds, json.dumps(trial.note), trial.because),
    )


def checksum_of(row: tuple[Any, ...]) -> int:
    """Return the checksum of a row of values in the order in which they are stored."""
    return zlib.crc32(repr(row).encode("utf-8", "backslashreplace"))


def read_trial(row: tuple[Any, ...], checksum: Any) -> Trial | None:
    """Return the trial of a row; None if the row is damaged, or if its values are not those of a trial."""
    number, origin, state, point, names, attempts, executed, distance, failure, seconds, note, because = row
    if checksum_of(row) != checksum:
        return None
    try:
        unit_point, parameters, notes = read_json(point), read_json(names), read_json(note or "null", finite=False)
    except InputError:
        return None
    valid = (
        all(isinstance(count, int) and 0 <= count < 2**53 for count in (number, attempts)) and executed in (0, 1),
        state in get_args(State) and origin in get_args(Origin),
        _numbers(unit_point) and all(0 <= value <= 1 for value in unit_point),
        isinstance(parameters, dict)
        and all(isinstance(v, str) or _number(v) or _numbers(v) for v in parameters.values()),
        all(value is None or (isinstance(value, float) and 0 <= value < np.inf) for value in (distance, seconds)),
        (state == "completed") == (distance is not None),
        executed if state == "unmeasured" else state != "open" or not executed,
        isinstance(failure, str | None) and isinstance(notes, dict | None) and isinstance(because, str | None),
    )
    if not all(valid):
        return None
    where = np.array(unit_point, dtype=np.float64)
    known = Trial(number, origin, state, where, parameters, attempts, bool(executed), note=notes, because=because)
    return replace(known, distance=distance, failure=failure, seconds=seconds)


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
    text = json.dumps(value)
    if len(text) > MOST_CHARACTERS:
        raise InputError(f"{key} must have at most {MOST_CHARACTERS} characters as JSON to be stored, got {len(text)}.")
    return key, text


def read_trajectory(number: int, side: str, npz: Any, checksum: Any) -> Trajectory | None:
    """Return the trajectory of a row; None if it is damaged, or belongs to another trial or side."""
    if checksum_of((number, side, npz)) != checksum or not isinstance(npz, bytes):
        return None
    try:
        return Trajectory.from_npz(npz)
    except (InputError, TypeError, ValueError):
        return None
