"""A trial and a trajectory as rows of tables, with checksums."""

from __future__ import annotations

import json
import sqlite3
import sys
import zlib
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NoReturn, get_args

import numpy as np

from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Origin, State, Trial
from ctxval.errors import InputError

COLUMNS = (
    "number, origin, state, unit_point, parameters, attempts, executed, distance, failure, seconds, note, because, "
    "unmeasured"
)
"""Of a trial, as :func:`read_trial` takes them."""


CHECKED = 6
"""The schema version since which every row has a checksum; bringing a store to it writes those that are missing."""

ENDED = "state = ?, distance = ?, failure = ?, executed = ?, unmeasured = ?"
"""What :func:`ended_row` fills in."""


def ended_row(trial: Trial) -> tuple[Any, ...]:
    """Return the values that say how a trial ended."""
    state, unmeasured = _states(trial)
    return (state, real(trial.distance), trial.failure, int(trial.executed), unmeasured)


def _states(trial: Trial) -> tuple[str, int]:
    # Tables of version 0.1.0 take three states; what has no distance yet stands there as failed, and has a mark.
    return ("failed", 1) if trial.state == "unmeasured" else (trial.state, 0)


def row_of(trial: Trial) -> tuple[Any, ...]:
    """Return a trial as the values of its columns."""
    state, unmeasured = _states(trial)
    return (
        *(trial.number, trial.origin, state, json.dumps(trial.unit_point.tolist())),
        *(json.dumps(trial.parameters), trial.attempts, int(trial.executed)),
        *(real(trial.distance), trial.failure, real(trial.seconds), json.dumps(trial.note), trial.because, unmeasured),
    )


def real(value: float | None) -> float | None:
    """Return a number as SQLite gives it back."""
    return None if value is None else float(value)


def checksum_of(row: tuple[Any, ...]) -> int:
    """Return the checksum of a row, as it is stored."""
    return zlib.crc32(repr(row).encode("utf-8", "backslashreplace"))


def trial_checksum(row: tuple[Any, ...]) -> int:
    """Return the checksum of a trial's row; as before there were the last two columns where they say nothing."""
    return checksum_of(row if any(row[-2:]) else row[:-2])


def read_trial(row: tuple[Any, ...], checksum: Any, *, unchecked: bool = False) -> Trial | None:
    """Return the trial of a row; None where it is damaged, or is none that could have been stored.

    Args:
        row: the values of the columns.
        checksum: of the row.
        unchecked: whether it is of a version of the store without checksums.
    """
    number, origin, state, point, names, attempts, executed, distance, failure, seconds, note, because, unmeasured = row
    if not (unchecked and checksum is None) and trial_checksum(row) != checksum:
        return None
    try:
        unit_point, parameters, thought = read_json(point), read_json(names), read_json(note or "null", finite=False)
    except InputError:
        return None
    valid = (
        _count(number) and _count(attempts) and executed in (0, 1),
        state in _STATES and origin in get_args(Origin),
        _numbers(unit_point) and all(0 <= value <= 1 for value in unit_point),
        isinstance(parameters, dict) and all(_number(v) or _numbers(v) for v in parameters.values()),
        distance is None or (isinstance(distance, float) and 0 <= distance < np.inf),
        seconds is None or (isinstance(seconds, float) and 0 <= seconds < np.inf),
        (state == "completed") == (distance is not None) and (state != "open" or not executed),
        isinstance(failure, str | None) and isinstance(thought, dict | None) and isinstance(because, str | None),
        unmeasured in (None, 0) or (unmeasured == 1 and state == "failed" and executed),
    )
    if not all(valid):
        return None
    ended: State = "unmeasured" if unmeasured else state
    where = np.array(unit_point, dtype=np.float64)
    known = Trial(number, origin, ended, where, parameters, attempts, bool(executed), note=thought, because=because)
    return replace(known, distance=distance, failure=failure, seconds=seconds)


_STATES = ("open", "completed", "failed")
"""As they stand in the table."""


def _count(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value < _MOST


_MOST = 2**53
"""Beyond what anybody counts."""


def _number(value: Any) -> bool:
    """Return whether a value of JSON is a number that a float can hold."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_number, value))


def follows(trial: Trial, earlier: list[Trial]) -> bool:
    """Return whether a trial may be the next one after these."""
    same_space = not earlier or trial.unit_point.shape == earlier[0].unit_point.shape
    return trial.number == len(earlier) and same_space


def read_json(text: Any, *, finite: bool = True) -> Any:
    """Return the value of a text of JSON.

    Args:
        text: as a database gives it.
        finite: refuse what is written like NaN and infinity, as JSON itself does.

    Raises:
        InputError: it is no text, or none of JSON.
    """
    if not isinstance(text, str):
        raise InputError(f"JSON is text, got {type(text).__name__}.")
    try:
        value = json.loads(text, parse_constant=_refuse_constant if finite else None)
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"this is no JSON: {error}.") from error
    if not _shallow(value, _DEEPEST):
        raise InputError(f"JSON is nested at most {_DEEPEST} times here.")
    return value


_DEEPEST = 50


def _shallow(value: Any, levels: int) -> bool:
    if not isinstance(value, dict | list):
        return True
    items = value.values() if isinstance(value, dict) else value
    return levels > 0 and all(_shallow(item, levels - 1) for item in items)


def _refuse_constant(name: str) -> NoReturn:
    raise InputError(f"{name} is no number of JSON.")


def read_pairs(rows: Iterable[tuple[Any, Any]]) -> dict[str, Any]:
    """Return a table of keys and values of JSON.

    Raises:
        InputError: a key is no text or is there twice, or a value is no JSON.
    """
    found: dict[str, Any] = {}
    for key, value in rows:
        if not isinstance(key, str) or key in found:
            raise InputError(f"a key must be a text that is there once, got {key!r}.")
        found[key] = read_json(value, finite=False)
    return found


def read_trajectory(number: int, side: str, npz: Any, checksum: Any, *, unchecked: bool = False) -> Trajectory | None:
    """Return the trajectory of a row; None where it is damaged, or another one's."""
    if not (unchecked and checksum is None) and checksum_of((number, side, npz)) != checksum:
        return None
    try:
        return Trajectory.from_npz(npz) if isinstance(npz, bytes) else None
    except (InputError, TypeError, ValueError):
        return None


def write_checksums(connection: sqlite3.Connection) -> None:
    """Write checksums of rows that a version without them stored."""
    for row in connection.execute(f"SELECT {COLUMNS} FROM trials WHERE checksum IS NULL").fetchall():
        connection.execute("UPDATE trials SET checksum = ? WHERE number = ?", (trial_checksum(row), row[0]))
    missing = "SELECT rowid, trial, side FROM trajectories WHERE checksum IS NULL"
    for place, number, side in connection.execute(missing).fetchall():
        npz = connection.execute("SELECT npz FROM trajectories WHERE rowid = ?", (place,)).fetchone()[0]
        checksum = checksum_of((number, side, npz))
        connection.execute("UPDATE trajectories SET checksum = ? WHERE rowid = ?", (checksum, place))
