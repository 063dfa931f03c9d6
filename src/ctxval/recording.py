"""What is told of an execution that was made elsewhere, and whether it can be believed."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from pathlib import Path
from typing import IO

import numpy as np

from ctxval.arrays import Array
from ctxval.errors import InputError
from ctxval.trajectory import Trajectory
from ctxval.trial import Trial


def require_one_result(trajectory: Trajectory | None, distance: float | None, failed: str | None) -> None:
    """Check that an execution ended in exactly one way."""
    if sum(given is not None for given in (trajectory, distance, failed)) != 1:
        raise InputError("tell needs one of a trajectory, a distance and the reason of a failure.")


def known_distance(distance: float) -> float:
    """Return a distance that was told."""
    valid = isinstance(distance, int | float | np.number) and not isinstance(distance, bool)
    if not valid or not (np.isfinite(distance) and distance >= 0):
        raise InputError(f"the distance must be a finite number >= 0, got {distance!r}.")
    return float(distance)


def same_run(trial: Trial, unit_point: Array, distance: float | None, failed: str | None) -> bool:
    """Return whether a trial is an execution that is told again."""
    ended = trial.distance == distance and trial.failure == failed and trial.state != "open"
    return ended and np.array_equal(trial.unit_point, unit_point)


def kept_beside(trial: Trial, trajectory: Trajectory | None, store: Path | None) -> Path | None:
    """Write how a trial ended, which its store does not take, beside the store or where there is room.

    It is the trajectory as NPZ, or where there is none, the distance or the failure as JSON. What other attempts have
    left there stays.

    Returns:
        where it is; None if it can be written nowhere.
    """
    stem = "memory" if store is None else store.stem
    ended = {"trial": trial.number, "distance": trial.distance, "failure": trial.failure}
    content, suffix = (json.dumps(ended).encode(), "json") if trajectory is None else (trajectory.to_npz(), "npz")
    for folder in (Path() if store is None else store.parent, Path(tempfile.gettempdir())):
        for count in range(_KEPT):
            path = folder / f"{stem}.trial-{trial.number}{f'.{count}' if count else ''}.{suffix}"
            try:
                file = path.open("xb")
            except FileExistsError:
                continue
            except OSError:
                break
            if _flushed(file, content):
                return path
            with contextlib.suppress(OSError):
                path.unlink()
            break
    return None


_KEPT = 1000
"""Files of one trial that are kept in one folder."""


def _flushed(file: IO[bytes], content: bytes) -> bool:
    try:
        with file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        return False
    return True
