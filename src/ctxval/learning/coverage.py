"""How far the closed loops of the tasks lead from all recorded transitions, in states and inputs.

Gaps are those between the loops and all records. A pocket is a region of two states that loops enter and no execution
has entered: a post could stand there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Trajectory
from ctxval.learning.closed_loops import Loops, PlannedTasks
from ctxval.learning.dynamics_posterior import DynamicsPosterior

MOST_COORDINATES = 6
"""Largest number of state-input coordinates for which pairs of coordinates are compared."""
_FARTHEST = 1e3  # standardised coordinates are limited to this magnitude


@dataclass(frozen=True, eq=False)
class Gap:
    """A gap between what closed loops visit and what is recorded."""

    size: float  # its size, as a share of the visited range
    coordinates: tuple[int, ...]  # the indices of its coordinates; states come before inputs
    place: Array  # the visited state-input pair, in the system's units, (n + m,)


@dataclass(frozen=True, eq=False)
class Coverage(ShortRepr):
    """The largest gaps between what closed loops visit and what is recorded."""

    marginal: Gap  # the largest gap in a single coordinate
    beyond: Gap  # the largest excess over the largest record of a single coordinate, or below its smallest one
    # the largest gap in two coordinates together; None if there are too many coordinates to compare pairs
    pair: Gap | None
    task: Array  # the task whose closed loop leads farthest from the records, a point of the unit cube (d,)
    resolution: Array  # the largest gap of each coordinate, in the system's units, (n + m,)
    # the number of tasks that were compared with the range of the records; gaps are looked for in a part of them
    tasks: int


def coverage(
    posterior: DynamicsPosterior, tasks: Array, planned: Sequence[PlannedTasks], loops: Sequence[Loops]
) -> Coverage:
    """Return how well the records cover the closed loops of tasks ``(q, d)`` on the posterior mean."""
    visited, rows = _visited(posterior, loops), np.concatenate([tasks.rows for tasks in planned])
    width = _widths(visited)
    recorded, scaled = posterior.data.pairs / width, visited / width
    beyond = _beyond(recorded, scaled)
    # Gaps between the records are looked for in a part of the tasks and of the steps.
    compared = _some(len(scaled), 256)
    some = scaled[compared][:, _some(scaled.shape[1], 40)]
    gaps = np.stack([_nearest(recorded[:, i], some[..., i]) for i in range(len(width))], axis=-1)
    pairs, couples = None, list(combinations(range(len(width)), 2))
    if len(width) <= MOST_COORDINATES:
        trees = [(cKDTree(recorded[:, list(two)]), list(two)) for two in couples]
        pairs = np.stack([tree.query(some[..., two], p=np.inf)[0] for tree, two in trees], axis=-1)
    # What is beyond all records weighs ten times as much as a gap in one coordinate, and a gap in two of them less.
    far = 10.0 * beyond.max(axis=(1, 2))
    far[compared] += (gaps.max(axis=-1) + (0.0 if pairs is None else 0.3 * pairs.max(axis=-1))).max(axis=1)

    def largest(of: Array, coordinates: Sequence[tuple[int, ...]], where: Array) -> Gap:
        at = np.unravel_index(int(of.argmax()), of.shape)
        place = where[at[:-1]] * width * posterior.data.scale + posterior.data.shift
        return Gap(float(of[at]), coordinates[int(at[-1])], place)

    single = [(i,) for i in range(len(width))]
    return Coverage(
        largest(gaps, single, some),
        largest(beyond, single, scaled),
        None if pairs is None else largest(pairs, couples, some),
        tasks[rows[int(far.argmax())]],
        np.maximum(gaps.max(axis=(0, 1)), beyond.max(axis=(0, 1))) * width * posterior.data.scale,
        len(rows),
    )


def beyond_records(
    posterior: DynamicsPosterior, of_pool: Sequence[Loops], loops: Sequence[Loops], *, executed_only: bool = False
) -> list[Array]:
    """Return how far closed loops leave the records in any coordinate, as a share of the range of the pool's loops.

    Each array has a number for each task, in the order of the loops. With ``executed_only``, the data that M was made
    from are no records.
    """
    width = _widths(_visited(posterior, of_pool))
    pairs = posterior.data.pairs[posterior.data.sources >= 0] if executed_only else posterior.data.pairs
    recorded = pairs / width
    return [_beyond(recorded, _visited(posterior, [each]) / width).max(axis=(1, 2)) for each in loops]


def _widths(visited: Array) -> Array:
    low, high = np.quantile(visited, [1e-3, 1 - 1e-3], axis=(0, 1))
    return np.asarray(np.maximum(high - low, 1e-9))


def _beyond(recorded: Array, visited: Array) -> Array:
    """Return the excess of each coordinate over its largest record, or below its smallest one."""
    return np.asarray(np.maximum(np.maximum(visited - recorded.max(axis=0), recorded.min(axis=0) - visited), 0.0))


def _visited(posterior: DynamicsPosterior, loops: Sequence[Loops]) -> Array:
    """Return the standardised pairs ``(q, H, k)`` on loops; the last pair of a task with a shorter horizon repeats."""
    parts = [posterior.data.standardised(loop.states[0][:, :-1], loop.inputs[0]) for loop in loops]
    horizon = max(part.shape[1] for part in parts)
    longest = [np.pad(part, ((0, 0), (0, horizon - part.shape[1]), (0, 0)), mode="edge") for part in parts]
    visited = np.nan_to_num(np.concatenate(longest), nan=_FARTHEST, posinf=_FARTHEST, neginf=-_FARTHEST)
    return np.clip(visited, -_FARTHEST, _FARTHEST)


def _some(count: int, most: int) -> Rows:
    """Return at most so many of ``count`` rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


def _nearest(recorded: Array, visited: Array) -> Array:
    """Return the distance of each visited number ``(N,)`` to the nearest recorded one."""
    ordered = np.sort(recorded)
    above = np.clip(np.searchsorted(ordered, visited), 1, len(ordered) - 1)
    return np.minimum(np.abs(visited - ordered[above]), np.abs(visited - ordered[above - 1]))


# Pockets


@dataclass(frozen=True, eq=False)
class Pocket(ShortRepr):
    """The largest region of two states that closed loops of tasks enter, and that no execution has entered."""

    size: float  # its radius, as a share of the visited ranges
    states: tuple[int, int]  # the indices of the two states
    place: Array  # its centre, which a loop visits, in the system's units, (2,)
    # its radius in each of the two states, in the system's units, (2,); they are equal if the states are places with
    # one unit
    within: Array


def largest_pocket(visited: Array, executed: Sequence[Trajectory], units: Sequence[str]) -> Pocket | None:
    """Return the largest pocket; None if there are no two states, or nothing was executed.

    Two states with one unit that is no rate are places, and distances in their plane mean something. If there are such
    states, only they are compared; otherwise all are, each as a share of its range.

    Args:
        visited: states that closed loops of tasks visit, in the system's units, shape ``(N, n)``.
        executed: the executed trajectories.
        units: the unit of each state; empty if it is not known.
    """
    low, high = np.quantile(visited, [1e-3, 1 - 1e-3], axis=0)
    usual = visited[((visited >= low) & (visited <= high)).all(axis=1)]
    if not executed or not len(usual):
        return None
    parts, some = [], usual[_some(len(usual), 4000)]
    for trajectory in executed:  # eight points on the straight line of each step
        steps = np.arange(len(trajectory.states))
        fine = np.linspace(0, steps[-1], 8 * int(steps[-1]) + 1)
        parts.append(np.stack([np.interp(fine, steps, column) for column in trajectory.states.T], axis=-1))
    entered = np.concatenate(parts)
    widths, couples = np.maximum(high - low, 1e-9), list(combinations(range(len(units)), 2))
    places = [(i, j) for i, j in couples if units[i] == units[j] and units[i] and "/" not in units[i]]
    pockets = []
    for i, j in places or couples:
        width = widths[[i, j]]
        scale = np.full(2, width.max()) if places else width
        away, _ = cKDTree(entered[:, [i, j]] / scale).query(some[:, [i, j]] / scale)
        at = int(away.argmax())
        pockets.append(Pocket(float(away[at]), (i, j), some[at, [i, j]], away[at] * scale))
    return max(pockets, key=lambda pocket: pocket.size, default=None)
