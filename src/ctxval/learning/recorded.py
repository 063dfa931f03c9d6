"""Recorded transitions of a system: those of its executions, and the model's own data near the tasks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array, Rows
from ctxval.core.model import Model
from ctxval.core.rollout import rollout
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.core.validation import Validation
from ctxval.models.scaling import standard_deviations

_POOL = 3000
"""Largest number of transitions that these are chosen from."""
_DATA = 600
"""Largest number of transitions of the model's own data in this pool: those nearest to the tasks."""
_LOGGED = 1500
"""Largest number of transitions of logs in this pool: those nearest to the tasks."""
_LOOPS = 64
"""Number of closed loops on M that show which transitions the tasks need."""
_SLOW_LOOPS = 3
"""Number of tasks that are tried one by one, if loops cannot be computed in a batch."""
_WORK = 30_000
"""Number of centres of a residual times the horizon; it bounds the time of a closed loop."""


def affordable_centres(horizon: int, least: int, most: int) -> int:
    """Return the number of transitions that a residual is conditioned on: fewer if closed loops have many steps.

    Args:
        horizon: the number of steps of a closed loop.
        least, most: the least and the largest number.
    """
    return int(np.clip(_WORK // horizon, least, most))


def recorded_transitions(
    model: Model, executed: Sequence[Trajectory], loops: Trajectory, logged: Sequence[Trajectory] = ()
) -> tuple[Transitions, Rows] | None:
    """Return the known transitions of the system and the execution of each; -1 for data that the model was made from.

    Returns None if there are none. Of many transitions, a random part is returned.

    Args:
        model: the model M, which may have data.
        executed: the system's trajectories.
        loops: closed loops on M, which show which of the other data the tasks need.
        logged: recordings that belong to no task; their numbers follow those of the executions.
    """
    parts = [trajectory.transitions() for trajectory in executed]
    sources = [np.full(len(part), k) for k, part in enumerate(parts)]
    if logged:
        others = [trajectory.transitions() for trajectory in logged]
        of = np.repeat(len(executed) + np.arange(len(others)), [len(part) for part in others])
        together = Transitions.joined(others)
        rows = _nearest_logged(together, loops)
        parts.append(Transitions(together.x[rows], together.u[rows], together.x_next[rows]))
        sources.append(of[rows])
    data = getattr(model, "data", None)
    if isinstance(data, Transitions) and len(data):
        parts.append(_nearest(data, loops))
        sources.append(np.full(len(parts[-1]), -1))
    if not parts:
        return None
    together, of = Transitions.joined(parts), np.concatenate(sources)
    if len(of) > _POOL:
        kept = np.sort(np.random.default_rng(len(of)).permutation(len(of))[:_POOL])
        together, of = Transitions(together.x[kept], together.u[kept], together.x_next[kept]), of[kept]
    return together, of


def closed_loops_on_model(validation: Validation) -> Trajectory | None:
    """Return closed loops on M for random tasks: a batch, or one task if there can be no batch.

    Returns None if no task can be planned.
    """
    space = validation.space
    points = space.from_unit(np.random.default_rng(0).random((_LOOPS, space.dimension)))
    batches = [points] if getattr(validation.synthesizer, "batched", False) else []
    for rows in [*batches, *points[:_SLOW_LOOPS]]:
        try:
            task = validation.task_at(space.parameters(rows))
            loops = rollout(validation.model.step, validation.synthesizer.design(task, validation.model), task)
        except Exception:  # the user's own parts, on tasks that may never be executed
            continue
        if loops.batch_shape == rows.shape[:-1]:
            return loops
    return None


def _nearest(data: Transitions, loops: Trajectory) -> Transitions:
    """Return the transitions that are nearest to the closed loops of the tasks."""
    if len(data) <= _DATA:
        return data
    here, there = _compared(data, loops)
    if not len(there):
        return data
    kept = np.sort(np.argsort(cdist(here, there).min(axis=1), kind="stable")[:_DATA])
    return Transitions(data.x[kept], data.u[kept], data.x_next[kept])


def _nearest_logged(data: Transitions, loops: Trajectory) -> Rows:
    """Return the rows of the logged transitions that are nearest to the closed loops of the tasks."""
    if len(data) <= _LOGGED:
        return np.arange(len(data))
    here, there = _compared(data, loops)
    if not len(there):
        return np.arange(len(data))
    gaps = cKDTree(there).query(here)[0]  # a tree, because logs are long
    return np.sort(np.argsort(gaps, kind="stable")[:_LOGGED])


def _compared(data: Transitions, loops: Trajectory) -> tuple[Array, Array]:
    """Return the pairs of transitions, and those of closed loops, in standard deviations of the former."""
    needed = loops.transitions()
    there = np.concatenate([needed.x, needed.u], axis=1)
    there = there[np.isfinite(there).all(axis=1)][:: max(1, len(there) // _POOL)]
    here = np.concatenate([data.x, data.u], axis=1)
    scale = standard_deviations(here)
    return here / scale, there / scale
