"""How far the closed loops of the tasks lead from all recorded transitions, in states and inputs.

Gaps are those between the loops and all records. A pocket is a region of two states that loops enter and no execution
has entered: a post could stand there.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, combinations, product

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows
from ctxval._util.texts import parted
from ctxval.core.coverage import StateInputCoverage, StateInputGap, UnsampledCorner, UnvisitedRegion
from ctxval.core.space import TaskSpace, are_coordinates_of_ground
from ctxval.core.trajectory import Trajectory
from ctxval.learning.closed_loops import Loops, PlannedTasks
from ctxval.learning.dynamics_posterior import DynamicsPosterior


def coverage(
    posterior: DynamicsPosterior,
    tasks: Array,
    planned: Sequence[PlannedTasks],
    loops: Sequence[Loops],
    labels: Sequence[str],
    most_coordinates: int = 6,
) -> StateInputCoverage:
    """Return how well the records cover the closed loops of tasks ``(q, d)`` on the posterior mean.

    States and inputs have these labels. With more coordinates than the largest number, pairs are not compared.
    """
    visited, rows = _visited(posterior, loops), np.concatenate([tasks.rows for tasks in planned])
    width = np.maximum(np.ptp(_ends(visited, (0, 1)), axis=0), 1e-9)
    recorded, scaled = posterior.data.recorded / width, visited / width
    beyond = beyond_range(recorded, scaled)
    # Gaps between the records are looked for in a part of the tasks and of the steps.
    compared = _some(len(scaled), 256)
    some = scaled[compared][:, _some(scaled.shape[1], 40)]
    gaps = np.empty(some.shape)  # to the nearest recorded number
    for i, ordered in enumerate(np.sort(recorded, axis=0).T):
        above = np.clip(np.searchsorted(ordered, some[..., i]), 1, len(ordered) - 1)
        gaps[..., i] = np.minimum(np.abs(some[..., i] - ordered[above]), np.abs(some[..., i] - ordered[above - 1]))
    pairs, couples = None, list(map(list, combinations(range(len(width)), 2)))
    if len(width) <= most_coordinates:
        trees = [(scipy.spatial.cKDTree(recorded[:, two]), two) for two in couples]
        pairs = np.stack([tree.query(some[..., two], p=np.inf)[0] for tree, two in trees], axis=-1)
    # What is beyond all records weighs ten times as much as a gap in one coordinate, and a gap in two of them less.
    far = 10.0 * beyond.max(axis=(1, 2))
    far[compared] += (gaps.max(axis=-1) + (0.0 if pairs is None else 0.3 * pairs.max(axis=-1))).max(axis=1)

    def named(values: Array) -> dict[str, float]:
        return dict(zip(labels, values.tolist(), strict=True))

    def largest(of: Array, coordinates: Sequence[tuple[str, ...]], where: Array) -> StateInputGap:
        at = np.unravel_index(int(of.argmax()), of.shape)
        place = where[at[:-1]] * width * posterior.data.scale + posterior.data.shift
        return StateInputGap(float(of[at]), coordinates[int(at[-1])], named(place))

    single = [(label,) for label in labels]
    return StateInputCoverage(
        largest(gaps, single, some),
        largest(beyond, single, scaled),
        None if pairs is None else largest(pairs, list(combinations(labels, 2)), some),
        named(np.maximum(gaps.max(axis=(0, 1)), beyond.max(axis=(0, 1))) * width * posterior.data.scale),
        tasks[rows[int(far.argmax())]],
        len(rows),
    )


def beyond_records(
    posterior: DynamicsPosterior, of_pool: Sequence[Loops], loops: Sequence[Loops], *, executed_only: bool = False
) -> list[Array]:
    """Return how far closed loops leave the records in any coordinate, as a share of the range of the pool's loops.

    Each array has a number for each task, in the order of the loops. With ``executed_only``, the data that M was made
    from are no records.
    """
    width = np.maximum(np.ptp(_ends(_visited(posterior, of_pool), (0, 1)), axis=0), 1e-9)
    data = posterior.data
    recorded = (data.recorded[data.executed] if executed_only else data.recorded) / width
    return [beyond_range(recorded, _visited(posterior, [each]) / width).max(axis=(1, 2)) for each in loops]


def beyond_range(recorded: Array, visited: Array) -> Array:
    """Return the excess ``(..., k)`` of coordinates over the largest of records ``(N, k)``, or below the smallest."""
    return np.asarray(np.maximum(np.maximum(visited - recorded.max(axis=0), recorded.min(axis=0) - visited), 0.0))


def _visited(posterior: DynamicsPosterior, loops: Sequence[Loops]) -> Array:
    """Return the standardised pairs ``(q, H, k)`` on loops; the last pair of a task with a shorter horizon repeats."""
    parts = [posterior.data.standardised(loop.states[0][:, :-1], loop.inputs[0]) for loop in loops]
    horizon = max(part.shape[1] for part in parts)
    longest = [np.pad(part, ((0, 0), (0, horizon - part.shape[1]), (0, 0)), mode="edge") for part in parts]
    return np.clip(_finite(np.concatenate(longest)), -1e3, 1e3)


def _finite(values: Array) -> Array:
    """Return values with large finite numbers in the place of those of loops that diverge."""
    return np.nan_to_num(values, nan=1e3, posinf=1e3, neginf=-1e3)


def _ends(visited: Array, axis: int | tuple[int, int]) -> Array:
    """Return the range of visited values, without one in a thousand on each side, shape ``(2, ...)``."""
    return np.asarray(np.quantile(visited, [1e-3, 1 - 1e-3], axis=axis))


def _some(count: int, most: int) -> Rows:
    """Return at most so many of ``count`` rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


# Pockets


def largest_pocket(
    visited: Array,
    executed: Sequence[Trajectory],
    labels: Sequence[str],
    positions: Sequence[Sequence[int]] = (),
    of_task: Rows | None = None,
    tasks: Array | None = None,
) -> UnvisitedRegion | None:
    """Return the largest pocket; None if there are no two states, or nothing was executed.

    Coordinates of a position, and two states with one unit that is no rate, are places, and distances in their plane
    mean something. If there are such states, only they are compared; otherwise all are, each as a share of its range.

    Args:
        visited: states that closed loops of tasks visit, in the system's units, shape ``(N, n)``.
        executed: the executed trajectories.
        labels: the label of each state, with its unit if that is known.
        positions: of each position that is a task parameter, the states that are its coordinates.
        of_task, tasks: of each visited state, the row of its task ``(N,)``, and these tasks, points of the unit cube
            ``(q, d)``; only needed if there are positions.
    """
    low, high = _ends(visited, 0)
    rows = np.flatnonzero(((visited >= low) & (visited <= high)).all(axis=1))
    if not executed or not len(rows):
        return None
    rows = rows[_some(len(rows), 4000)]
    some, entered = visited[rows], _entered(executed)
    widths, couples = np.maximum(high - low, 1e-9), list(combinations(range(len(labels)), 2))
    units = [parted(label)[1] for label in labels]
    places = list(dict.fromkeys(pair for position in positions for pair in combinations(sorted(position), 2)))
    places = places or [(i, j) for i, j in couples if units[i] == units[j] and units[i] and "/" not in units[i]]
    planes = []
    for i, j in places or couples:
        two, width = [i, j], widths[[i, j]]
        scale = np.full(2, width.max()) if places else width
        away, _ = scipy.spatial.cKDTree(entered[:, two] / scale).query(some[:, two] / scale)
        planes.append((away, two, scale))
    if not planes:
        return None
    away, two, scale = max(planes, key=lambda plane: plane[0].max())
    at, names = int(away.argmax()), [labels[k] for k in two]
    place, within = some[at, two].tolist(), (away[at] * scale).tolist()
    next_tasks: tuple[tuple[float, ...], ...] = ()
    if positions and of_task is not None and tasks is not None:
        # The task whose run leaves the smallest pockets, large ones above all.
        few, left = _some(len(some), 1000), np.full(len(tasks), np.inf)
        for row in np.unique(of_task):
            path = scipy.spatial.cKDTree(visited[of_task == row][:, two] / scale)
            left[row] = (np.minimum(away[few], path.query(some[few][:, two] / scale)[0]) ** 6).sum()
        next_tasks = tuple(map(tuple, tasks[[left.argmin(), of_task[rows[at]]]].tolist()))
    return UnvisitedRegion(
        float(away[at]), dict(zip(names, place, strict=True)), dict(zip(names, within, strict=True)), next_tasks
    )


def away_from_executions(
    executed: Sequence[Trajectory], positions: Sequence[Sequence[int]], of_pool: Sequence[Loops], loops: Sequence[Loops]
) -> list[Array]:
    """Return how far closed loops come from all places that executions entered, as a share of the range of the pool's.

    Each array has a number for each task, in the order of the loops.

    Args:
        positions: of each position, the two states that are its coordinates.
    """
    away = [np.zeros(each.states.shape[1]) for each in loops]
    if not positions:
        return away
    entered = _entered(executed)
    visited = np.concatenate([each.states[0].reshape(-1, entered.shape[1]) for each in of_pool])
    widths = np.ptp(_ends(visited[np.isfinite(visited).all(axis=1)], 0), axis=0)
    for two in map(list, positions):
        scale = max(float(widths[two].max()), 1e-9)
        tree = scipy.spatial.cKDTree(entered[:, two] / scale)
        for k, each in enumerate(loops):
            away[k] = np.maximum(away[k], tree.query(_finite(each.states[0][..., two] / scale))[0].max(axis=1))
    return away


def _entered(executed: Sequence[Trajectory]) -> Array:
    """Return states that executions entered ``(N, n)``, eight on the straight line of each step."""
    parts = []
    for trajectory in executed:
        steps = np.arange(len(trajectory.states))
        fine = np.linspace(0, steps[-1], 8 * int(steps[-1]) + 1)
        parts.append(np.stack([np.interp(fine, steps, column) for column in trajectory.states.T], axis=-1))
    return np.concatenate(parts)


def position_states(
    space: TaskSpace, labels: Sequence[str], planned: Sequence[PlannedTasks], points: Array, *, goals: bool = True
) -> list[list[int]]:
    """Return, of each position that tasks choose, the two states that are its coordinates on the ground.

    In each task, these states begin at a position that is a task parameter, or have it as their goal, in any unit,
    origin and direction. Of three coordinates, the first two are taken: posts and walls stand on the ground, and runs
    do not enter all of a volume in a few executions. If no parameter is a position, two states are coordinates if
    their labels say so, and tasks vary where they begin or their goal in two dimensions, such as by a radius and an
    angle.

    Args:
        labels: the label of each state, with its unit if that is known.
        points: the tasks in the order of their planning, points of the unit cube ``(q, d)``.
        goals: whether goals are states, and no outputs.
    """
    values = space.from_unit(points[np.concatenate([each.rows for each in planned])])
    known = ("initial_state", "goal") if goals else ("initial_state",)
    ends = [np.concatenate([np.atleast_2d(getattr(each.task, end)) for each in planned]) for end in known]

    def standardised(columns: Array) -> Array:
        centred = columns - columns.mean(axis=0)
        return np.asarray(centred / np.maximum(np.linalg.norm(centred, axis=0), 1e-300))

    groups = list[list[int]]()
    for at in space.positions:
        # States and parameters that are coordinates of one axis have a correlation of 1 or -1.
        fits = [np.abs(standardised(values[:, at]).T @ standardised(end)) > 1 - 1e-9 for end in ends]
        same = [[*chain.from_iterable(map(np.flatnonzero, states))] for states in zip(*fits, strict=True)]
        if all(same):
            groups.append([int(states[0]) for states in same][:2])
    if groups:
        return groups
    for two in map(list, combinations(range(len(labels)), 2)):
        if are_coordinates_of_ground(*(labels[state] for state in two)):
            spreads = [np.linalg.svd(end[:, two] - end[:, two].mean(axis=0), compute_uv=False) for end in ends]
            if any(small > 0.1 * large for large, small in spreads):  # a plane rather than a line
                groups.append(two)
    return groups


# Parameters and corners


def farthest_value(
    known: Array, places: Array | None = None, rng: np.random.Generator | None = None
) -> tuple[float, float]:
    """Return the largest distance of a value in [0, 1], or of places ``(m,)``, from known ones ``(n,)``, and the value.

    A generator chooses among values that are as far.
    """
    if not len(known):
        return 1.0, 0.5
    ordered = np.sort(known)
    if places is None:  # the ends of the range, and the middles between neighbours
        places = np.concatenate([[0.0], 0.5 * (ordered[1:] + ordered[:-1]), [1.0]])
    away = np.abs(places[:, None] - ordered).min(axis=1)
    farthest = np.flatnonzero(away >= away.max() - 1e-9)
    chosen = int(farthest[0] if rng is None else rng.choice(farthest))
    return float(away[chosen]), float(places[chosen])


def unsampled_corner(executed: Array, space: TaskSpace, task: Array) -> UnsampledCorner | None:
    """Return the corner that is farthest from executed tasks ``(n, d)``; None if no task parameter is a position.

    Its task has the parameters of ``task`` ``(d,)``, except that each position moves to its own farthest corner.
    """
    components, farthest, task = [0, 0], 0.0, task.copy()
    for at in space.positions:
        k = at.stop - at.start
        ends, pairs = np.array(list(product((0.0, 1.0), repeat=k))), list(map(list, combinations(range(k), 2)))
        away = np.abs(ends[:, None] - executed[:, at])
        gaps = np.stack([away[..., pair].max(axis=2).min(axis=1, initial=1.0) for pair in pairs])
        # Of the corners with the largest gap, one task tries as many other pairs as it can.
        corner = int(np.lexsort((gaps.sum(axis=0), gaps.max(axis=0)))[-1])
        task[at], worst = ends[corner], int(gaps[:, corner].argmax())
        if gaps[worst, corner] > farthest:
            components, farthest = [at.start + i for i in pairs[worst]], float(gaps[worst, corner])
    if not farthest:
        return None
    values = space.from_unit(task)
    return UnsampledCorner({space.labels[j]: float(values[j]) for j in components}, farthest, task)
