"""What is told of an execution that was made elsewhere, and whether it can be believed."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import numpy as np

from ctxval.arrays import Array
from ctxval.errors import InputError
from ctxval.trajectory import COMPLETE, Trajectory
from ctxval.trial import Trial
from ctxval.validation import Plan, require_execution, require_task


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


def require_recording(plan: Plan, trajectory: Trajectory | None, start_tolerance: float) -> None:
    """Check that a recording is a whole execution of a plan."""
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"a Trajectory is needed, got {type(trajectory).__name__}.")
    if trajectory.ended == COMPLETE:
        require_task(plan, trajectory, start_tolerance)
    require_execution(plan, trajectory)


def same_run(trial: Trial, unit_point: Array, distance: float | None, failed: str | None) -> bool:
    """Return whether a trial is an execution that is told again."""
    ended = trial.distance == distance and trial.failure == failed and trial.state != "open"
    return ended and np.array_equal(trial.unit_point, unit_point)


def kept_beside(trajectory: Trajectory, number: int, store: Path | None) -> Path | None:
    """Write an execution that its store does not take beside it, or where there is room; return where, or None."""
    stem = "memory" if store is None else store.stem
    for folder in (Path() if store is None else store.parent, Path(tempfile.gettempdir())):
        path = folder / f"{stem}.trial-{number}.npz"
        try:
            file = path.open("xb")
        except OSError:
            continue
        try:
            with file:
                file.write(trajectory.to_npz())
            return path
        except OSError:
            with contextlib.suppress(OSError):
                path.unlink()
    return None
