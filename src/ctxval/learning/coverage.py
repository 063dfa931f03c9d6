"""How far the closed loops of the tasks lead from all recorded transitions, in states and inputs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from ctxval._util.arrays import Array
from ctxval._util.representation import record
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.dynamics_posterior import DynamicsPosterior

MOST_COORDINATES = 6
"""Largest number of state-input coordinates for which pairs of coordinates are compared."""
_STEPS = 40
"""Largest number of steps of each closed loop that are compared."""
_FARTHEST = 1e3
"""Standardised coordinates are limited to this magnitude."""
_TAIL = 1e-3
"""Share of the visited coordinates on each side that does not count in their range."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """The largest gaps between what closed loops visit and what is recorded, as shares of the visited range.

    Attributes:
        marginal: the largest gap in a single coordinate.
        pair: the largest gap in two coordinates together; None if there are too many coordinates to compare pairs.
        coordinate: the index of the coordinate with the largest gap; states come before inputs.
        place: the state-input pair where it is, in the system's units, shape ``(n + m,)``.
        task: the task whose closed loop leads farthest from the records, a point of the unit cube ``(d,)``.
        resolution: the largest gap of each coordinate, in the system's units, shape ``(n + m,)``.
        tasks: the number of tasks that were compared.
    """

    marginal: float
    pair: float | None
    coordinate: int
    place: Array
    task: Array
    resolution: Array
    tasks: int

    def __repr__(self) -> str:
        return record(self)


def coverage(planner: LoopPlanner, posterior: DynamicsPosterior, tasks: Array) -> Coverage:
    """Return how well the records cover the closed loops of tasks on the posterior mean.

    Args:
        planner: designs controllers and runs closed loops.
        posterior: the posterior of the dynamics, with its data.
        tasks: points of the unit cube ``(q, d)``.
    """
    visited, rows = _visited(planner, posterior, tasks)
    low, high = np.quantile(visited, [_TAIL, 1 - _TAIL], axis=(0, 1))
    width = np.maximum(high - low, 1e-9)
    recorded = posterior.data.pairs / width
    scaled = (visited / width).reshape(-1, len(width))
    gaps = np.stack([_nearest(recorded[:, i], scaled[:, i]) for i in range(len(width))], axis=1)
    paired = _pair_gaps(recorded, scaled)
    marginal = gaps.max(axis=1)
    far = marginal if paired is None else marginal + 0.3 * paired
    worst, of_task = int(marginal.argmax()), far.reshape(visited.shape[:2]).max(axis=1)
    return Coverage(
        float(marginal.max()),
        None if paired is None else float(paired.max()),
        int(gaps[worst].argmax()),
        visited.reshape(-1, len(width))[worst] * posterior.data.scale + posterior.data.shift,
        tasks[rows[int(of_task.argmax())]],
        gaps.max(axis=0) * width * posterior.data.scale,
        len(rows),
    )


def _visited(planner: LoopPlanner, posterior: DynamicsPosterior, tasks: Array) -> tuple[Array, Array]:
    """Return the standardised pairs ``(q, steps, k)`` on loops of the mean, and the rows of their tasks ``(q,)``."""
    planned = planner.plan(tasks)
    parts = []
    for loops in planner.run(posterior.mean, planned):
        horizon = loops.inputs.shape[2]
        at = np.unique(np.linspace(0, horizon - 1, min(horizon, _STEPS)).astype(int))
        parts.append(posterior.data.standardised(loops.states[0][:, at], loops.inputs[0][:, at]))
    visited = np.clip(np.nan_to_num(np.concatenate(parts)), -_FARTHEST, _FARTHEST)
    return visited, np.concatenate([one.rows for one in planned])


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
        cKDTree(recorded[:, list(two)]).query(visited[:, list(two)], p=np.inf)[0] for two in combinations(range(k), 2)
    ]
    return np.asarray(np.max(gaps, axis=0))
