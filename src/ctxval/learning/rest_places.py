"""Places where friction at rest is tested: a joint left rest there under a force that hardly exceeds the usual one.

That dry friction holds a joint with the same force everywhere is an assumption. A detent, or the dent of a bearing, may
hold with more. Joints that slide past it do not show it, nor do those that leave it under a large force. A joint that
leaves rest at a place under a small force refutes that the place holds with more than this force.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.core.coverage import UntestedRest
from ctxval.core.trajectory import Transitions
from ctxval.learning.closed_loops import LoopPlanner, Loops, PlannedTasks
from ctxval.learning.dry_friction import DryFriction
from ctxval.learning.dynamics_posterior import DynamicsPosterior

REST_GAP = 0.0375
"""Largest distance of a tested place, as a share of the range in which joints leave rest: 7.5 % lie between two."""
FACTOR = 3.0  # multiple of the usual friction at rest that is said to hold at an untested place
_MORE = 1.5  # multiple of the usual friction at rest up to which a force tests a place
_LEAST = 1.1  # least multiple of the smallest force that moved a joint up to which a force tests a place
_AIMED = 0.9  # share of this force that tasks for a test have
_HARDER = 1.3  # by how much the force of a task exceeds the one that the joint withstood there
_SLOW = 0.05  # rate up to which a joint may be at rest, as a share of its root mean square
_MOVED = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005)  # steps of a search for a task, as shares of the cube
_TRIED, _KEPT = 48, 8  # tasks in each of these steps, and the best ones
_APART = 0.3  # share of ``REST_GAP`` by which a place may differ from the one that is looked for
_WITHIN = 0.05  # share by which a force may differ from the one that is looked for
_NEAR = 2.0  # largest difference of a task that is found, in units of the two


@dataclass(frozen=True, eq=False)
class Departures:
    """Where joints leave rest, or are held, in d steps."""

    places: Array  # the coordinate of the joint (d,)
    forces: Array  # what acts on it there, in units of its input, without friction's part that grows with it (d,)
    rows: Rows  # of predicted runs, the task (d,)

    def __getitem__(self, which: Array) -> Departures:
        return Departures(self.places[which], self.forces[which], self.rows[which])


@dataclass(frozen=True, eq=False)
class RestPlaces:
    """Where the friction at rest of one joint is tested, and where predicted runs need it."""

    posterior: DynamicsPosterior
    planner: LoopPlanner
    joint: int
    coordinate: int  # the state that is the joint's coordinate
    pool: Array  # tasks that stand for all, points (N, d)
    errors: Array  # the usual errors of forces (m,)
    left: Departures  # where the joint left rest in executions
    held: Departures  # where it did not
    predicted: Departures  # where it leaves rest in predicted runs of the pool
    usual: float  # the usual friction at rest: the mean of what motion shows, and of the least force that moved it
    allowed: float  # the largest force that tests a place

    @functools.cached_property
    def needed(self) -> Departures:
        """The predicted departures that larger friction at rest would prevent."""
        return self.predicted[self.predicted.forces <= FACTOR * self.usual]

    @functools.cached_property
    def width(self) -> float:
        """The range of these places, in the unit of the coordinate."""
        return max(float(np.ptp(self.needed.places)), 1e-300) if len(self.needed.places) else 1e-300

    @functools.cached_property
    def farthest(self) -> tuple[float, float]:
        """The largest distance of a needed place from a tested one, as a share of the range, and this place.

        A place is tested by a departure under the force that is needed there, or an allowed one.
        """
        needed, left = self.needed, self.left
        most = np.maximum(needed.forces, self.allowed)[:, None]
        away = np.where(left.forces <= most, np.abs(needed.places[:, None] - left.places), self.width)
        nearest = away.min(axis=1, initial=self.width)
        row = int(nearest.argmax())
        return float(nearest[row]) / self.width, float(needed.places[row])

    @property
    def aim(self) -> tuple[float, float]:
        """A place next to the farthest one from which fewest departures fill the gap, and the force for a test."""
        place, radius = self.farthest[1], REST_GAP * self.width
        tested = np.sort(self.left.places[self.left.forces <= self.allowed])
        low, high = float(self.needed.places.min()), float(self.needed.places.max())
        below, above = tested[tested <= place], tested[tested > place]
        if not len(below):
            place = min(low + _AIMED * radius, high)
        elif not len(above):
            place = max(high - _AIMED * radius, low)
        else:
            gap = above[0] - below[-1]
            place = float(below[-1] + gap / max(np.ceil(gap / (2 * radius)), 2))
        # Where a force did not move the joint, a larger one may.
        withstood = self.held.forces[np.abs(self.held.places - place) <= radius].max(initial=0.0)
        return place, max(_AIMED * self.allowed, _HARDER * float(withstood))

    def tasks(self, place: float, force: float, rng: np.random.Generator) -> Array:
        """Return tasks ``(k, d)`` whose predicted runs leave rest about there under about this force, the best first.

        It is empty if no such task is found.
        """
        scale = _APART * REST_GAP * self.width

        def missed(found: Departures, count: int) -> Array:
            least = np.full(count, np.inf)
            away = np.hypot((found.places - place) / scale, np.log(found.forces / force) / _WITHIN)
            np.minimum.at(least, found.rows, away)
            return least

        points, errors = self.pool, missed(self.predicted, len(self.pool))
        moves = self.planner.batched and self.planner.validation.space.members is None
        for step in _MOVED if moves else ():
            best = np.argsort(errors, kind="stable")[:_KEPT]
            moved = np.repeat(points[best], _TRIED // _KEPT, axis=0)
            moved = np.clip(moved + step * rng.uniform(-1, 1, moved.shape), 0.0, 1.0)
            planned = self.planner.plan(moved)
            loops = self.planner.run(self.posterior.mean, planned)
            found = predicted_departures(self.posterior, planned, loops, self.joint, self.coordinate, self.errors)
            points = np.concatenate([points[best], moved])
            errors = np.concatenate([errors[best], missed(found, len(moved))])
        order = np.argsort(errors, kind="stable")[:_KEPT]
        return np.asarray(points[order[errors[order] <= _NEAR]])

    def like(self, task: Array, rng: np.random.Generator) -> Array | None:
        """Return a task whose predicted run leaves rest under the same force where a test is needed; None without one.

        It is None if the run of the given task ``(d,)`` tests no place.
        """
        planned = self.planner.plan(task[None])
        loops = self.planner.run(self.posterior.mean, planned)
        found = predicted_departures(self.posterior, planned, loops, self.joint, self.coordinate, self.errors)
        force = float(found.forces.min(initial=np.inf))
        if not force <= self.allowed:
            return None
        tasks = self.tasks(self.aim[0], force, rng)
        return np.asarray(tasks[0]) if len(tasks) else None


def rest_places(
    posterior: DynamicsPosterior,
    planner: LoopPlanner,
    pool: Array,
    planned: Sequence[PlannedTasks],
    loops: Sequence[Loops],
) -> list[RestPlaces]:
    """Return where the friction at rest of each joint is tested and needed; nothing of joints without coordinates.

    The loops are those of the pool's tasks on the posterior mean, without noise.
    """
    friction, steps, places = posterior.covariances.model, posterior.data.executions, list[RestPlaces]()
    pushes = posterior.pushes
    if not isinstance(friction, DryFriction) or pushes is None:
        return places
    for j, coordinate in enumerate(friction.coordinates(steps)):
        shown = float(friction.rest[:, j].max())
        if coordinate is None or not shown > 0:
            continue
        at, force = steps.x[:, coordinate], pushes.force[:, j]

        def those(which: Mask, at: Array = at, force: Array = force) -> Departures:
            return Departures(at[which], force[which], np.flatnonzero(which))

        left = those(pushes.started[:, j] | pushes.turned[:, j])
        lowest = float(force[pushes.started[:, j]].min(initial=np.inf))
        usual = 0.5 * (shown + lowest) if np.isfinite(lowest) else shown
        allowed = float(np.clip(_MORE * usual, _LEAST * lowest, _MORE * lowest)) if np.isfinite(lowest) else shown
        predicted = predicted_departures(posterior, planned, loops, j, coordinate, pushes.errors)
        held = those(pushes.held[:, j])
        places.append(
            RestPlaces(posterior, planner, j, coordinate, pool, pushes.errors, left, held, predicted, usual, allowed)
        )
    return places


def predicted_departures(
    posterior: DynamicsPosterior,
    planned: Sequence[PlannedTasks],
    loops: Sequence[Loops],
    joint: int,
    coordinate: int,
    errors: Array,
) -> Departures:
    """Return where a joint leaves rest, or turns, in closed loops on the posterior mean."""
    friction = posterior.covariances.model
    assert isinstance(friction, DryFriction)
    rate, found = int(friction.rates[joint]), list[tuple[Array, Array, Rows]]()
    for plan, each in zip(planned, loops, strict=True):
        x, u = each.states[0], each.inputs[0, ..., : posterior.data.inputs]
        before, after = x[:, :-1, rate], x[:, 1:, rate]
        slow = _SLOW * np.sqrt(np.nanmean(np.where(np.isfinite(x[..., rate]), x[..., rate], 0.0) ** 2))
        may = (np.abs(before) <= slow) & (np.abs(after) > friction.still[joint]) | (before * after < 0)
        task, step = np.nonzero(may & np.isfinite(x).all(axis=2)[:, 1:])
        if len(task):
            some = Transitions(x[task, step], u[task, step], x[task, step + 1])
            pushes = posterior.pushes_in(some, errors)
            which = (pushes.started | pushes.turned)[:, joint]
            found.append((some.x[which, coordinate], pushes.force[which, joint], plan.rows[task[which]]))
    if not found:
        return Departures(np.empty(0), np.empty(0), np.empty(0, dtype=np.intp))
    return Departures(*(np.concatenate(part) for part in zip(*found, strict=True)))


def untested_rest(places: Sequence[RestPlaces], labels: Sequence[str], rng: np.random.Generator) -> UntestedRest | None:
    """Return the place that is farthest from those where friction at rest was tested; None if none is in need.

    States have these labels.
    """
    needing = [each for each in places if len(each.needed.places)]
    if not needing:
        return None
    worst = max(needing, key=lambda each: each.farthest[0])
    size, place = worst.farthest
    posterior, planner = worst.posterior, worst.planner
    mean = posterior.mean
    assert isinstance(mean.model, DryFriction)
    # What is predicted if every place held with as much as an untested one may.
    rest = mean.model.rest.copy()
    rest[..., worst.joint] = np.maximum(rest[..., worst.joint], FACTOR * worst.usual)
    strong = replace(mean, model=replace(mean.model, rest=rest))
    tasks: Array = np.empty((0, worst.pool.shape[1]))
    highest = np.inf
    if size > REST_GAP:
        distances = planner.distances(strong, planner.plan(worst.pool), len(worst.pool))
        highest = float(np.nanmax(distances, initial=0.0))
        tasks = worst.tasks(*worst.aim, rng)
    label = labels[worst.coordinate]
    return UntestedRest(
        size, {label: place}, size * worst.width, worst.allowed, highest, tuple(map(tuple, tasks.tolist()))
    )
