"""The input of a search from stored trials: its history, and a prediction from the trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.campaign.storage.store import Store
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.searches import Prediction


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


def for_known_values(prediction: Prediction, trials: Sequence[Trial], executed: Sequence[Trial]) -> Prediction:
    """Return a prediction learned from executed trials, with one row for each known value of a search."""
    known = [trial for trial in history_of(trials) if trial.distance is not None]
    if [trial.number for trial in known] == [trial.number for trial in executed]:
        return prediction
    # A distance without a recording is a value that the search knows, but there is no trajectory for it.
    row_of = {trial.number: row for row, trial in enumerate(executed)}
    row_of_known = np.array([row_of.get(trial.number, -1) for trial in known], dtype=np.intp)
    points = np.array([trial.unit_point for trial in known])

    def left_out_of(part: Prediction) -> Callable[[Rows], Array]:
        def left_out(rows: Rows) -> Array:
            values = np.empty(len(rows))
            has_trajectory = row_of_known[rows] >= 0
            if has_trajectory.any():
                values[has_trajectory] = part.left_out(row_of_known[rows[has_trajectory]])
            if not has_trajectory.all():
                # Nothing was learned from this point, so leaving it out does not change the prediction there.
                values[~has_trajectory] = part.expected(points[rows[~has_trajectory]])[0]
            return values

        return left_out

    return prediction.with_rows(left_out_of)
