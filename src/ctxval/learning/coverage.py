"""How far the closed loops of the tasks lead from all recorded transitions, in states and inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import record
from ctxval.learning.closed_loops import LoopPlanner, PlannedTasks
from ctxval.learning.dynamics_posterior import DynamicsPosterior

MOST_COORDINATES = 6
"""Largest number of state-input coordinates for which pairs of coordinates are compared."""
_TASKS, _STEPS = 256, 40
"""Largest numbers of tasks, and of steps of each closed loop, in which gaps between the records are looked for."""
_BEYOND, _PAIR = 10.0, 0.3
"""Weights of a state or input beyond all records, and of a gap in two coordinates, against a gap in one of them."""
_FARTHEST = 1e3
"""Standardised coordinates are limited to this magnitude."""
_TAIL = 1e-3
"""Share of the visited coordinates on each side that does not count in their range."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """The largest gaps between what closed loops visit and what is recorded, as shares of the visited range.

    Attributes:
        marginal: the largest gap in a single coordinate.
        beyond: how far the loops lead beyond the smallest or the largest record of a single coordinate.
        pair: the largest gap in two coordinates together; None if there are too many coordinates to compare pairs.
        coordinate: the index of the coordinate with the worst of these gaps; states come before inputs.
        place: the state-input pair where it is, in the system's units, shape ``(n + m,)``.
        task: the task whose closed loop leads farthest from the records, a point of the unit cube ``(d,)``.
        resolution: the largest gap of each coordinate, in the system's units, shape ``(n + m,)``.
        tasks: the number of tasks that were compared with the range of the records; gaps are looked for in a part of
            them.
    """

    marginal: float
    beyond: float
    pair: float | None
    coordinate: int
    place: Array
    task: Array
    resolution: Array
    tasks: int

    def __repr__(self) -> str:
        return record(self)


def coverage(
    planner: LoopPlanner, posterior: DynamicsPosterior, tasks: Array, planned: Sequence[PlannedTasks]
) -> Coverage:
    """Return how well the records cover the closed loops of tasks on the posterior mean.

    Args:
        planner: runs closed loops.
        posterior: the posterior of the dynamics, with its data.
        tasks: points of the unit cube ``(q, d)``.
        planned: their plans.
    """
    visited, rows = _visited(planner, posterior, planned)
    low, high = np.quantile(visited, [_TAIL, 1 - _TAIL], axis=(0, 1))
    width = np.maximum(high - low, 1e-9)
    recorded, scaled = posterior.data.pairs / width, visited / width
    beyond = np.maximum(np.maximum(scaled - recorded.max(axis=0), recorded.min(axis=0) - scaled), 0.0)
    some = scaled[_some(len(scaled), _TASKS)][:, _some(scaled.shape[1], _STEPS)]
    gaps = np.stack([_nearest(recorded[:, i], some[..., i]) for i in range(len(width))], axis=-1)
    paired = _pair_gaps(recorded, some)
    badness = _BEYOND * beyond.max(axis=(1, 2))
    badness[_some(len(scaled), _TASKS)] += (gaps.max(axis=-1) + (0.0 if paired is None else _PAIR * paired)).max(axis=1)
    worst = (beyond, scaled) if _BEYOND * beyond.max() > gaps.max() else (gaps, some)
    at = np.unravel_index(int(worst[0].argmax()), worst[0].shape)
    return Coverage(
        float(gaps.max()),
        float(beyond.max()),
        None if paired is None else float(paired.max()),
        int(at[-1]),
        worst[1][at[:-1]] * width * posterior.data.scale + posterior.data.shift,
        tasks[rows[int(badness.argmax())]],
        np.maximum(gaps.max(axis=(0, 1)), beyond.max(axis=(0, 1))) * width * posterior.data.scale,
        len(rows),
    )


def _visited(planner: LoopPlanner, posterior: DynamicsPosterior, planned: Sequence[PlannedTasks]) -> tuple[Array, Rows]:
    """Return the standardised pairs ``(q, H, k)`` on loops of the mean, and the rows of their tasks ``(q,)``."""
    parts = [
        posterior.data.standardised(loops.states[0][:, :-1], loops.inputs[0])
        for loops in planner.run(posterior.mean, planned)
    ]
    visited = np.clip(np.nan_to_num(np.concatenate(parts)), -_FARTHEST, _FARTHEST)
    return visited, np.concatenate([one.rows for one in planned])


def _some(count: int, most: int) -> Rows:
    """Return at most so many of ``count`` rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


def _nearest(recorded: Array, visited: Array) -> Array:
    """Return the distance of each visited number ``(N,)`` to the nearest recorded one."""
    ordered = np.sort(recorded)
    above = np.clip(np.searchsorted(ordered, visited), 1, len(ordered) - 1)
    return np.minimum(np.abs(visited - ordered[above]), np.abs(visited - ordered[above - 1]))


def _pair_gaps(recorded: Array, visited: Array) -> Array | None:
    """Return the largest gap over pairs of coordinates at each visited pair; None if there are too many coordinates."""
    k = recorded.shape[1]
    if k > MOST_COORDINATES:
        return None
    gaps = [
        cKDTree(recorded[:, list(two)]).query(visited[..., list(two)], p=np.inf)[0] for two in combinations(range(k), 2)
    ]
    return np.asarray(np.max(gaps, axis=0))
