"""The input of a search from stored trials: its history, and the executed trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ctxval._util.arrays import Array
from ctxval.campaign.storage.store import Store
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial, Trials


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
    completed = Trials(trials).completed
    executed = store.trajectories(completed.numbers, "system")
    return [(trial, executed[trial.number]) for trial in completed if trial.number in executed]


def at_points(executed: Sequence[tuple[Trial, Trajectory]]) -> list[tuple[Array, Trajectory]]:
    """Return executed trajectories with the points ``(d,)`` of their trials in the unit cube."""
    return [(trial.unit_point, trajectory) for trial, trajectory in executed]
