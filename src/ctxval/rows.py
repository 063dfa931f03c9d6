"""A trial and a trajectory as rows of tables, with checksums."""

from __future__ import annotations

import json
import zlib
from typing import Any, get_args

import numpy as np

from ctxval.errors import InputError
from ctxval.trajectory import Trajectory
from ctxval.trial import Origin, State, Trial

COLUMNS = "number, origin, state, unit_point, parameters, attempts, executed, distance, failure, seconds, note, because"
"""Of a trial, as :func:`read_trial` takes them."""


def row_of(trial: Trial) -> tuple[Any, ...]:
    """Return a trial as the values of its columns."""
    return (
        *(trial.number, trial.origin, trial.state, json.dumps(trial.unit_point.tolist())),
        *(json.dumps(trial.parameters), trial.attempts, int(trial.executed)),
        *(real(trial.distance), trial.failure, real(trial.seconds), json.dumps(trial.note), trial.because),
    )


def real(value: float | None) -> float | None:
    """Return a number as SQLite gives it back."""
    return None if value is None else float(value)


def checksum_of(row: tuple[Any, ...]) -> int:
    """Return the checksum of a row, as it is stored."""
    return zlib.crc32(repr(row).encode("utf-8", "backslashreplace"))


def trial_checksum(row: tuple[Any, ...]) -> int:
    """Return the checksum of a trial's row; of one without ``because`` as before there was that column."""
    return checksum_of(row if row[-1] is not None else row[:-1])


def read_trial(row: tuple[Any, ...], checksum: Any) -> Trial | None:
    """Return the trial of a row; None where it is damaged. Rows of older versions have no checksum."""
    number, origin, state, point, names, attempts, executed, distance, failure, seconds, note, because = row
    if checksum is not None and trial_checksum(row) != checksum:
        return None
    try:
        unit_point = np.array(json.loads(point), dtype=np.float64)
        numbers = (distance is None or isinstance(distance, float)) and (state == "completed") == (distance is not None)
        if not numbers or unit_point.ndim != 1 or state not in get_args(State) or origin not in get_args(Origin):
            return None
        return Trial(
            *(int(number), origin, state, unit_point, json.loads(names), int(attempts), bool(executed)),
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
