"""Closed loops of many drawn systems under controllers designed on M, whole batches of tasks and draws at once."""

from __future__ import annotations

import contextlib
import functools
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.boxes import moves_to_bounds
from ctxval._util.progress import advance
from ctxval.core.controller import Controller, ControllerWithMemory, started
from ctxval.core.model import Step
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.errors import DistanceError
from ctxval.learning.draws import Draws
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.effects.inputs import NO_EFFECTS, InputEffects
from ctxval.learning.noisy_draws import NoisyPosterior

T = TypeVar("T")
AnyPosterior = DynamicsPosterior | NoisyPosterior  # of dynamics without and with noise

_UNITS = "closed loops", "designs", "tasks"  # of stages that closed loops are progress of


@dataclass(frozen=True, eq=False)
class PlannedTasks:
    """Tasks with their controllers and the trajectories of M: a batch, or one task without batch axes."""

    rows: Rows  # the rows of these tasks among all points that were planned, (q,)
    task: Task
    controller: Controller
    nominal: Trajectory


@dataclass(frozen=True, eq=False)
class Loops:
    """Closed loops of S drawn systems on q tasks; noisy ones have S R, with R sequences of noise for each draw."""

    distances: Array  # d, (S, q); NaN if the loop of M diverges, infinity if that of a drawn system does
    states: Array  # shape (S, q, H + 1, n)
    inputs: Array  # those that act, shape (S, q, H, m)


class LoopPlanner:
    """Designs controllers for points of the unit cube, and runs drawn systems in closed loop with them.

    The latest plans are kept, up to about ``kept_bytes``. Tasks that are planned together are kept together, because a
    controller of a batch need not have parts; they are found again if the same points are asked for in the same order.
    In drawn systems, inputs have ``effects``; M has none.
    """

    def __init__(
        self, validation: Validation, effects: InputEffects = NO_EFFECTS, kept_bytes: int = 64_000_000
    ) -> None:
        self.validation, self.effects, self.kept_bytes = validation, effects, kept_bytes
        self._together: bool | None = None
        self._kept: OrderedDict[bytes, tuple[list[PlannedTasks], int]] = OrderedDict()
        self._size = 0

    @functools.cached_property
    def batched(self) -> bool:
        """Whether the task function and the synthesizer take several tasks in one call."""
        if not getattr(self.validation.synthesizer, "batched", False):
            return False
        middle = np.full(self.validation.space.dimension, 0.5)
        for spread in (0.0, 0.25, 0.5):
            points = np.stack([middle - spread, middle, middle + spread])
            with contextlib.suppress(Exception):  # the user's own parts, on tasks that may never be executed
                self._plan(points, np.arange(3))
                return True
        return False

    def plan(self, points: Array, together: int = 512) -> list[PlannedTasks]:
        """Return the plans of points ``(q, d)``, at most ``together`` in one call, without those without a design."""
        size, plans = together if self.batched else 1, list[PlannedTasks]()
        for first in range(0, len(points), size):
            some = points[first : first + size]
            key = some.tobytes()
            if key in self._kept:
                self._kept.move_to_end(key)
                planned = self._kept[key][0]
            else:
                planned = self._planned(some)
                # Trajectories, and gains as large as those of a linear feedback.
                arrays = [(plan.nominal.states, plan.nominal.inputs) for plan in planned]
                needed = sum(2 * (x.nbytes + u.nbytes) + int(x.shape[-1]) * u.nbytes for x, u in arrays) + len(key)
                self._kept[key] = planned, needed
                self._size += needed
                while self._size > self.kept_bytes:
                    self._size -= self._kept.popitem(last=False)[1][1]
            advance(len(some), units=_UNITS)  # as if those that are kept were planned again
            plans += [replace(plan, rows=first + plan.rows) for plan in planned]
        return plans

    def has(self, point: Array) -> bool:
        """Return whether the plan of one task ``(d,)`` is kept."""
        return point.tobytes() in self._kept

    def _planned(self, points: Array) -> list[PlannedTasks]:
        """Return plans. A batch that fails is halved; one task is then planned without batch axis."""
        plans = []
        batches = halved(lambda rows: self._plan(points[rows] if self.batched else points[rows[0]], rows), len(points))
        for rows, plan in batches:
            if plan is None and self.batched:
                with contextlib.suppress(Exception):  # the user's own parts, on tasks that may never be executed
                    plan = self._plan(points[rows[0]], rows)
            if plan is not None:
                plans.append(plan)
        return plans

    def _plan(self, chosen: Array, rows: Rows) -> PlannedTasks:
        parts = self.validation
        task = parts.task_at(parts.space.parameters(parts.space.from_unit(chosen)))
        controller = parts.synthesizer.design(task, parts.model)
        nominal = self._until_fall(parts.closed_loop(controller, task), task)
        if nominal.batch_shape != chosen.shape[:-1]:
            raise ValueError("the task function did not return one task for each point")
        return PlannedTasks(rows, task, controller, nominal)

    def run(self, draws: Draws, planned: Sequence[PlannedTasks]) -> list[Loops]:
        """Return the closed loops of all draws on the same tasks."""
        runs, sizes = len(draws) * draws.replicates, [len(plan.rows) for plan in planned]
        rows = (np.arange(runs * size).reshape(runs, size) for size in sizes)
        return [self._loops(draws, *each) for each in zip(planned, rows, sizes, strict=True)]

    def distances(self, draws: Draws, planned: Sequence[PlannedTasks], tasks: int) -> Array:
        """Return the distances ``(S, q)`` of all draws on the same q tasks; NaN for a task without a finite plan."""
        distances = distances_of(draws, self.run(draws, planned), planned, tasks)
        advance(len(draws) * sum(len(plan.rows) for plan in planned), units=_UNITS)
        return distances

    def distance_of(self, point: Array, trajectory: Trajectory) -> float:
        """Return the distance of an execution of a task ``(d,)``; 0 if it is not known."""
        for plan in self.plan(point[None]):
            model = plan.nominal
            if model.states.size == trajectory.states.size:
                shapes = model.states.shape, model.inputs.shape
                states, inputs = (
                    x.reshape(s) for x, s in zip((trajectory.states, trajectory.inputs), shapes, strict=True)
                )
                distance = self.compared(plan, Trajectory(model.times, states, inputs))
                return float(np.nan_to_num(distance, posinf=0.0)[0])
        return 0.0

    def own_distances(self, draws: Draws, points: Array) -> Array:
        """Return the distances ``(S, q)`` of each draw on tasks of its own, at points ``(S, q, d)``."""
        (S, q, d), R = points.shape, draws.replicates
        distances = np.full(S * R * q, np.nan)
        # One row for each sequence of noise, with the tasks of all draws.
        rows = np.arange(S * R * q).reshape(S, R, q).swapaxes(0, 1).reshape(R, S * q)
        for plan in self.plan(points.reshape(S * q, d), together=S * q):
            some = rows[:, plan.rows]
            distances[some] = self._loops(draws, plan, some, q).distances
            advance(some.size, units=_UNITS)
        return draws.reduced(distances.reshape(S * R, q))

    def _until_fall(self, run: Trajectory, task: Task) -> Trajectory:
        """Return loops in which robots lie still from their fall on; what M predicts afterwards does not matter."""
        fall = self.validation.fall
        return run if fall is None else fall.lying(run, task.times)

    def _loops(self, draws: Draws, planned: PlannedTasks, rows: Rows, tasks: int) -> Loops:
        """Return closed loops of draws; ``rows`` ``(L, q)`` says which, of all with so many tasks for each system."""
        task, L = planned.task, len(rows)
        rows = rows.reshape(L, *task.batch_shape)
        if self._takes_draws_together(planned, L):
            first, step = draws.begun(rows, tasks, np.repeat(task.initial_state[None], L, axis=0))
            together = rollout(self.with_effects(step), planned.controller, task.starting_at(first))
            loops = [Trajectory(together.times, together.states[k], together.inputs[k]) for k in range(L)]
        else:
            alone = (draws.begun(each, tasks, task.initial_state) for each in rows)
            loops = [
                rollout(self.with_effects(step), planned.controller, task.starting_at(first)) for first, step in alone
            ]
        loops = [self._until_fall(loop, task) for loop in loops]
        states, inputs = np.stack([loop.states for loop in loops]), np.stack([loop.inputs for loop in loops])
        shape = L, len(planned.rows)
        distances = np.array([self.compared(planned, loop) for loop in loops]).reshape(shape)
        inputs = self.effects.acting(inputs)
        return Loops(distances, *(part.reshape(*shape, *part.shape[-2:]) for part in (states, inputs)))

    def with_effects(self, step: Step) -> Step:
        """Return a step for the inputs that are commanded, which is called once for each step of a loop."""
        if not self.effects.effects:
            return step
        memory = None

        def following(x: Array, u: Array) -> Array:
            nonlocal memory
            u = np.array(u, dtype=np.float64)
            if memory is None:
                memory = np.zeros((*u.shape[:-1], self.effects.remembered(u.shape[-1])))
            acting, memory = self.effects.act(u, memory)
            return step(x, acting)

        return following

    def _takes_draws_together(self, planned: PlannedTasks, draws: int) -> bool:
        """Return whether controllers take draws as another first axis; if not, one loop is run after the other."""
        if draws > 1 and self._together is None:
            start, controller = planned.task.initial_state, planned.controller
            probes = start + 1e-3 * np.arange(draws).reshape(-1, *[1] * start.ndim)
            # The first input may not depend on the memory yet.
            steps = min(10, planned.task.horizon) if isinstance(controller, ControllerWithMemory) else 1
            self._together = False
            with contextlib.suppress(Exception), np.errstate(all="ignore"):  # the user's controller
                together = _probed(controller, planned.task.starting_at(probes), steps)
                each = [_probed(controller, planned.task.starting_at(probe), steps) for probe in probes]
                alone = np.stack(each, axis=1)
                self._together = together.shape == alone.shape and np.allclose(together, alone, equal_nan=True)
        return draws > 1 and bool(self._together)

    def compared(self, planned: PlannedTasks, loops: Trajectory) -> Array:
        """Return the distances ``(q,)`` of loops; infinity if one ends alone or is not measured, NaN if M diverges."""
        task, nominal, between = planned.task, planned.nominal, self.validation.distance_between
        finite, predicts = (nominal.finite, loops.finite), nominal.predicts
        model, system, known = nominal, loops, finite[0] & finite[1]
        if (both := predicts & ~finite[0] & loops.predicts & ~finite[1]).any():  # they ended early
            common, known = np.minimum(nominal.lengths, loops.lengths), known | both
            model, system = (run.held(common, task.times) for run in (nominal, loops))
        if not known.all():  # a distance need not take what is not finite
            kept = known[..., None, None]
            model, system = (
                Trajectory(run.times, np.where(kept, run.states, 0.0), np.where(kept, run.inputs, 0.0))
                for run in (model, system)
            )
        values = np.empty(0)
        with contextlib.suppress(DistanceError):
            values = between(model, system, task)
        if values.shape != known.shape:
            values = np.full(known.shape, np.inf)
            for k in range(known.size if known.ndim else 0):
                with contextlib.suppress(DistanceError):
                    alone = between(model[k], system[k], task[k])
                    values[k] = alone if not alone.shape else np.inf
        distances = np.where(known & np.isfinite(values), values, np.inf)
        return np.where(predicts, distances, np.nan).reshape(len(planned.rows))


def _probed(controller: Controller, task: Task, steps: int) -> Array:
    """Return the inputs ``(steps, ..., m)`` of a controller along states that change from step to step."""
    pi, x = started(controller, task), np.array(task.initial_state)
    return np.stack([np.asarray(pi(t, x * (1 + 0.1 * t)), dtype=np.float64) for t in range(steps)])


def halved(function: Callable[[Rows], T], count: int) -> list[tuple[Rows, T | None]]:
    """Return what a function of all rows returns; rows where it fails are halved, and a single one of them has None."""
    results: list[tuple[Rows, T | None]] = []
    left = [np.arange(count)]
    while left:
        rows = left.pop()
        try:
            results.append((rows, function(rows)))
        except Exception:  # the user's parts
            if len(rows) > 1:
                left += reversed(np.array_split(rows, 2))
            else:
                results.append((rows, None))
    return results


def distances_of(draws: Draws, loops: Sequence[Loops], planned: Sequence[PlannedTasks], tasks: int) -> Array:
    """Return the distances ``(S, q)`` of closed loops of S draws on planned tasks; NaN for a task without a plan."""
    distances = np.full((len(draws), tasks), np.nan)
    for plan, of_batch in zip(planned, loops, strict=True):
        distances[:, plan.rows] = draws.reduced(of_batch.distances)
    return distances


def loop_pairs(planner: LoopPlanner, posterior: AnyPosterior, tasks: Array) -> Array:
    """Return standardised pairs ``(N, k)`` that the mean's loops on tasks visit, none far away or without pivots."""
    parts = [np.empty((0, posterior.data.pairs.shape[1]))]
    for loops in planner.run(posterior.mean, planner.plan(tasks) if posterior.has_pivots else []):
        visited = posterior.data.standardised(loops.states[..., :-1, :], loops.inputs)
        parts.append(visited.reshape(-1, visited.shape[-1]))
    pairs = np.concatenate(parts)
    return np.asarray(pairs[(np.abs(pairs) < 1e3).all(axis=1)])


def unseen_parameters(planner: LoopPlanner, some: Array) -> tuple[int, ...]:
    """Return the indices of the task parameters that change the closed loops of M by less than 2 % of their deviation.

    What they change in the system, such as a payload, is no function of state and input. One parameter after the other
    of some tasks ``(q, d)`` is moved to its bounds.
    """
    d = some.shape[1]
    ends = moves_to_bounds(some, np.zeros(d), np.ones(d)).reshape(-1, d)
    loops: dict[int, Array] = {}
    for plan in planner.plan(ends):
        nominal = np.concatenate([plan.nominal.states[..., :-1, :], plan.nominal.inputs], axis=-1)
        nominal[~np.isfinite(nominal)] = np.nan  # M diverges
        loops.update(zip(plan.rows.tolist(), nominal.reshape(len(plan.rows), *nominal.shape[-2:]), strict=True))
    if not loops:
        return ()
    size = np.maximum(np.nanstd(np.concatenate(list(loops.values())), axis=0), 1e-12)
    effects = np.zeros(d)
    for first in range(0, len(ends), 2 * d):
        for j in range(d):
            low, high = loops.get(first + j), loops.get(first + d + j)
            if low is not None and high is not None and low.shape == high.shape:
                effects[j] = max(effects[j], float(np.nanmax(np.abs(high - low) / size, initial=0.0)))
    return tuple(np.flatnonzero(effects < 0.02).tolist())
