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
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.effects.dry_friction import DryFriction


@dataclass(frozen=True)
class RestSettings:
    """Which forces test friction at rest at a place, and how tasks with such forces are looked for.

    They were chosen on the systems cylinder, rotary-seal and detent-rail of benchmarks/friction_systems.py.
    """

    factor: float = 3.0  # multiple of the usual friction at rest that an untested place may hold with
    tests: float = 1.75  # multiple of the usual friction at rest up to which a force tests a place
    most: float = 1.5  # the same, of the smallest force that moved the joint
    least: float = 1.1  # least multiple of this smallest force up to which a force tests a place
    aimed: float = 0.8  # share of the largest force that tests a place, for tasks that shall test one
    harder: float = 1.3  # by how much the force of a task exceeds the one that the joint withstood there
    mostly: tuple[float, float] = (1e-3, 1 - 1e-3)  # quantiles of the needed places that are their range
    first: float = 2.0  # largest multiple of what motion shows that a task has which also bounds friction at rest
    moves_off: float = 0.02  # share of the largest rate of a slow joint at which one may have left rest
    moves: tuple[float, ...] = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005)  # steps of a search for tasks, as shares of the cube
    tried: int = 48  # tasks in each of these steps
    kept: int = 8  # the best tasks, from which the next step begins
    filled: float = 0.955  # stretches that tasks shall leave between tested places, as a share of the most
    apart: float = 0.05  # share of the longest stretch by which a task's place may differ from that which is aimed at
    apart_in_force: float = 0.05  # share by which its force may differ


SETTINGS = RestSettings()


@dataclass(frozen=True, eq=False)
class Departures:
    """Where joints leave rest, or are held, in d steps."""

    places: Array  # the coordinate of the joint (d,)
    forces: Array  # what acts on it there, in units of its input, without friction's part that grows with it (d,)
    rows: Rows  # of predicted runs, the task (d,)

    def __getitem__(self, which: Mask) -> Departures:
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
    shown: float  # what holds the joint at rest if that is no more than what motion shows
    usual: float  # the usual friction at rest: the mean of this, and of the least force that moved the joint
    allowed: float  # the largest force that tests a place

    @functools.cached_property
    def needed(self) -> Departures:
        """The predicted departures that larger friction at rest would prevent."""
        needed = self.predicted[self.predicted.forces <= SETTINGS.factor * self.usual]
        if not len(needed.places):
            return needed
        low, high = np.quantile(needed.places, SETTINGS.mostly)
        return needed[(needed.places >= low) & (needed.places <= high)]

    @functools.cached_property
    def width(self) -> float:
        """The range of these places, in the unit of the coordinate."""
        return max(float(np.ptp(self.needed.places)), 1e-300) if len(self.needed.places) else 1e-300

    @functools.cached_property
    def widest(self) -> tuple[float, int]:
        """The longest stretch without a tested place around a needed one, as a share of the range, and its row.

        A place is tested by a departure under the force that is needed there, or an allowed one.
        """
        needed, left = self.needed, self.left
        if not len(needed.places):
            return 0.0, 0
        tests = left.forces <= np.maximum(needed.forces, self.allowed)[:, None]
        away = left.places - needed.places[:, None]
        above = np.where(tests & (away >= 0), away, np.inf).min(axis=1, initial=np.inf)
        below = np.where(tests & (away <= 0), -away, np.inf).min(axis=1, initial=np.inf)
        stretch = np.minimum(above, needed.places.max() - needed.places)
        stretch += np.minimum(below, needed.places - needed.places.min())
        stretch = np.minimum(stretch, 2 * np.minimum(above, below))  # no run needs other places of it
        row = int(stretch.argmax())
        return float(stretch[row]) / self.width, row

    @property
    def aim(self) -> tuple[float, float]:
        """A place in this stretch from which fewest departures fill it, and a force that tests the place."""
        place, most = float(self.needed.places[self.widest[1]]), UntestedRest.MOST * self.width
        tested = self.left.places[self.left.forces <= self.allowed]
        low = tested[tested <= place].max(initial=self.needed.places.min())
        high = tested[tested >= place].min(initial=self.needed.places.max())
        place = float(low + (high - low) / max(np.ceil((high - low) / (SETTINGS.filled * most)), 2))
        # Where a force did not move the joint, a larger one may.
        withstood = self.held.forces[np.abs(self.held.places - place) <= 0.5 * most].max(initial=0.0)
        return place, max(SETTINGS.aimed * self.allowed, SETTINGS.harder * float(withstood))

    def tasks(self, place: float, force: float, rng: np.random.Generator) -> Array:
        """Return tasks ``(k, d)`` whose predicted runs leave rest about there under about this force, the best first.

        It is empty if no such task is found.
        """
        scale = SETTINGS.apart * UntestedRest.MOST * self.width

        def missed(found: Departures, count: int) -> Array:
            least = np.full(count, np.inf)
            away = np.hypot((found.places - place) / scale, np.log(found.forces / force) / SETTINGS.apart_in_force)
            np.minimum.at(least, found.rows, away)
            return least

        points, errors = self.pool, missed(self.predicted, len(self.pool))
        moves = self.planner.batched and self.planner.validation.space.members is None
        for step in SETTINGS.moves if moves else ():
            best = np.argsort(errors, kind="stable")[: SETTINGS.kept]
            moved = np.repeat(points[best], SETTINGS.tried // SETTINGS.kept, axis=0)
            moved = np.clip(moved + step * rng.uniform(-1, 1, moved.shape), 0.0, 1.0)
            planned = self.planner.plan(moved)
            loops = self.planner.run(self.posterior.mean, planned)
            found = predicted_departures(self.posterior, planned, loops, self.joint, self.coordinate, self.errors)
            points = np.concatenate([points[best], moved])
            errors = np.concatenate([errors[best], missed(found, len(moved))])
        order = np.argsort(errors, kind="stable")[: SETTINGS.kept]
        return np.asarray(points[order[errors[order] <= 2]])

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
        tasks = self.tasks(self.aim[0], min(force, SETTINGS.first * self.shown), rng)
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
    friction, steps, places = posterior.model, posterior.data.executions, list[RestPlaces]()
    if not isinstance(friction, DryFriction) or friction.told is None:
        return places
    pushes = friction.told.pushes
    for j, coordinate in enumerate(friction.coordinates(steps)):
        shown = float(friction.rest[:, j].max())
        if coordinate is None or not shown > 0:
            continue
        at, force = steps.x[:, coordinate], pushes.force[:, j]

        def those(which: Mask, at: Array = at, force: Array = force) -> Departures:
            return Departures(at[which], force[which], np.flatnonzero(which))

        left = those(pushes.started[:, j] | pushes.turned[:, j])
        usual = allowed = shown
        if pushes.started[:, j].any():
            lowest = float(force[pushes.started[:, j]].min())
            usual = 0.5 * (shown + lowest)
            allowed = float(np.clip(SETTINGS.tests * usual, SETTINGS.least * lowest, SETTINGS.most * lowest))
        predicted = predicted_departures(posterior, planned, loops, j, coordinate, pushes.errors)
        held = those(pushes.held[:, j])
        places.append(
            RestPlaces(
                posterior, planner, j, coordinate, pool, pushes.errors, left, held, predicted, shown, usual, allowed
            )
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
    friction = posterior.model
    assert isinstance(friction, DryFriction)
    assert friction.told is not None
    rate, found = int(friction.rates[joint]), list[tuple[Array, Array, Rows]]()
    slow = friction.still[joint] / friction.settings.held
    for plan, each in zip(planned, loops, strict=True):
        x, u = each.states[0], each.inputs[0]
        before, after = x[:, :-1, rate], x[:, 1:, rate]
        may = (np.abs(before) <= slow) & (np.abs(after) > np.abs(before)) & (np.abs(after) > SETTINGS.moves_off * slow)
        may |= before * after < 0
        task, step = np.nonzero(may & np.isfinite(x).all(axis=2)[:, 1:])
        if len(task):
            some = Transitions(x[task, step], u[task, step], x[task, step + 1])
            pushes = friction.pushes(some, friction.told.missed, errors)
            which = (pushes.started | pushes.turned)[:, joint]
            found.append((some.x[which, coordinate], pushes.force[which, joint], plan.rows[task[which]]))
    if not found:
        return Departures(np.empty(0), np.empty(0), np.empty(0, dtype=np.intp))
    return Departures(*(np.concatenate(part) for part in zip(*found, strict=True)))


def untested_rest(places: Sequence[RestPlaces], labels: Sequence[str], rng: np.random.Generator) -> UntestedRest | None:
    """Return the longest stretch of places where friction at rest was not tested; None if no place is in need.

    States have these labels.
    """
    needing = [each for each in places if len(each.needed.places)]
    if not needing:
        return None
    worst = max(needing, key=lambda each: each.widest[0])
    size, row = worst.widest
    posterior, planner = worst.posterior, worst.planner
    mean = posterior.mean
    assert isinstance(mean.model, DryFriction)
    # What is predicted if every place held with as much as an untested one may.
    rest = mean.model.rest.copy()
    rest[..., worst.joint] = np.maximum(rest[..., worst.joint], SETTINGS.factor * worst.usual)
    strong = replace(mean, model=replace(mean.model, rest=rest))
    tasks: Array = np.empty((0, worst.pool.shape[1]))
    highest = np.inf
    if size > UntestedRest.MOST:
        distances = planner.distances(strong, planner.plan(worst.pool), len(worst.pool))
        highest = float(np.nanmax(distances, initial=0.0))
        tasks = np.concatenate([worst.tasks(*worst.aim, rng), worst.pool[worst.needed.rows[[row]]]])
    place = {labels[worst.coordinate]: float(worst.needed.places[row])}
    further = worst.allowed, SETTINGS.factor, highest, tuple(map(tuple, tasks.tolist()))
    return UntestedRest(size, place, size * worst.width, *further)
