"""The input of a search from stored trials: its history, the executed trajectories, and the points that wait."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign.storage.store import Store
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial


def history_of(trials: Sequence[Trial]) -> list[Trial]:
    """Return the trials as a search keeps them: a point without a value occurs once, even if it has several trials."""
    history: list[Trial] = []
    waiting: dict[bytes, int] = {}
    for trial in trials:
        key = trial.unit_point.tobytes()
        if key in waiting:
            slot = waiting[key]
            history[slot] = replace(trial, note=history[slot].note)
        else:
            slot = waiting[key] = len(history)
            history.append(trial)
        if trial.distance is not None:
            del waiting[key]
    return history


def executed_trials(store: Store, trials: Sequence[Trial]) -> list[tuple[Trial, Trajectory]]:
    """Return the completed trials that have a trajectory of the system, with these trajectories."""
    completed = [trial for trial in trials if trial.state == "completed"]
    executed = store.trajectories([trial.number for trial in completed], "system")
    return [(trial, executed[trial.number]) for trial in completed if trial.number in executed]


def largest_distance(trials: Sequence[Trial]) -> float:
    """Return the largest distance of trials; 0 if none is known."""
    return max((trial.distance or 0.0 for trial in trials), default=0.0)


def waiting_points(trials: Sequence[Trial]) -> Array:
    """Return the points of open trials, which are being executed, ``(k, d)``."""
    return np.array([trial.unit_point for trial in trials if trial.state == "open"])
