"""What is told of an execution that was made elsewhere, and whether it can be believed."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.texts import text_of
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import TOLD_ALONE, Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, DistanceError, InputError
from ctxval.storage.disks import sync_folder


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
    # A distance that another processor has computed differs in its last digits.
    if trial.distance is None or distance is None:
        same = trial.distance is distance
    else:
        same = bool(np.isclose(trial.distance, distance, rtol=1e-9, atol=0))
    ended = same and trial.failure == failed and trial.state != "open"
    return ended and np.array_equal(trial.unit_point, unit_point)


def as_told(trials: list[Trial]) -> list[Trial]:
    """Return the trials as a search keeps them: of a point that waits for its value there is one."""
    told: list[Trial] = []
    waiting: dict[bytes, int] = {}
    for trial in trials:
        key = trial.unit_point.tobytes()
        if key in waiting:
            slot = waiting[key]
            told[slot] = replace(trial, note=told[slot].note)
        else:
            slot = waiting[key] = len(told)
            told.append(trial)
        if trial.distance is not None:
            del waiting[key]
    return told


def told_value(trial: Trial) -> float:
    """Return what a search is told of a trial: its distance, NaN if there is none."""
    return np.nan if trial.distance is None else trial.distance


# Measuring again


def outcome_of(trial: Trial) -> dict[str, Any]:
    """Return what measuring again may change of a trial."""
    return {"state": trial.state, "distance": trial.distance, "failure": trial.failure}


def measured_again(
    validation: Validation,
    trials: Sequence[Trial],
    trajectories: Callable[[Trial], tuple[Trajectory | None, Trajectory | None]],
    *,
    redefined: bool,
) -> list[Trial]:
    """Return the trials that end otherwise once their distances are measured anew, as they end then.

    Args:
        validation: has the distance.
        trials: of a store.
        trajectories: returns those of the model and of the system of a trial.
        redefined: whether the distance is another one than the stored values are of.

    Raises:
        DistanceError: the distance of a trial that had one cannot be measured any more.
    """
    now = [_measured_again(validation, trial, trajectories, redefined) for trial in trials]
    return [trial for trial, before in zip(now, trials, strict=True) if outcome_of(trial) != outcome_of(before)]


def _measured_again(validation: Validation, trial: Trial, trajectories: Any, redefined: bool) -> Trial:
    if trial.state == "open" or not trial.executed:
        return trial
    model, system = trajectories(trial)
    if model is None or system is None:
        told = trial.distance is not None and redefined
        return replace(trial, state="unmeasured", distance=None, failure=TOLD_ALONE) if told else trial
    try:
        distance = validation.remeasure(validation.space.from_unit(trial.unit_point), model, system)
    except DistanceError as error:
        if trial.distance is not None:
            sentence = f"trial {trial.number} cannot be measured anew, and nothing is changed: {error}"
            raise DistanceError(sentence) from error
        return replace(trial, state="unmeasured", failure=text_of(error))
    return replace(trial, state="completed", distance=distance, failure=None)


# What a store does not take


def rescued(ended: Trial, trajectory: Trajectory | None, store: Path | None, error: CtxvalError) -> CtxvalError:
    """Keep how an execution ended that its store does not take; return the error that says where it is kept."""
    if not ended.executed:
        return error
    path = kept_beside(ended, trajectory, store)
    if path is None:
        return type(error)(f"{error} How trial {ended.number} ended could not be kept either.")
    how = f"--npz {path}" if trajectory is not None else "--failed or --distance as it says"
    return type(error)(
        f"{error} How trial {ended.number} ended is kept in {path}: once the store can take it, "
        f"say `ctxval tell STORE {ended.number} {how}` before anything else."
    )


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
                sync_folder(folder)
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
