"""A trial and a trajectory as rows of tables, with checksums."""

from __future__ import annotations

import json
import zlib
from typing import Any, get_args

import numpy as np

from ctxval.errors import InputError
from ctxval.trajectory import Trajectory
from ctxval.trial import Origin, State, Trial

COLUMNS = (
    "number, origin, state, unit_point, parameters, attempts, executed, distance, failure, seconds, note, because, "
    "unmeasured"
)
"""Of a trial, as :func:`read_trial` takes them."""


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


def read_trial(row: tuple[Any, ...], checksum: Any) -> Trial | None:
    """Return the trial of a row; None where it is damaged. Rows of older versions have no checksum."""
    number, origin, state, point, names, attempts, executed, distance, failure, seconds, note, because, unmeasured = row
    if checksum is not None and trial_checksum(row) != checksum:
        return None
    try:
        unit_point = np.array(json.loads(point), dtype=np.float64)
        numbers = (distance is None or isinstance(distance, float)) and (state == "completed") == (distance is not None)
        if not numbers or unit_point.ndim != 1 or state not in get_args(State) or origin not in get_args(Origin):
            return None
        return Trial(
            *(
                int(number),
                origin,
                "unmeasured" if unmeasured else state,
                unit_point,
                json.loads(names),
                int(attempts),
                bool(executed),
            ),
            *(distance, failure, seconds, json.loads(note or "null"), because),
        )
    except (ValueError, TypeError, RecursionError):
        return None


def read_trajectory(number: int, side: str, npz: Any, checksum: Any) -> Trajectory | None:
    """Return the trajectory of a row; None where it is damaged, or another one's."""
    if checksum is not None and checksum_of((number, side, npz)) != checksum:
        return None
    try:
        return Trajectory.from_npz(bytes(npz))
    except (InputError, TypeError, ValueError):
        return None
