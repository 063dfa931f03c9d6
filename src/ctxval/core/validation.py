"""The pure map from task parameters to the distance d(p) (lines 6 to 9 of the paper's Algorithm 1)."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import replace
from typing import Any
from weakref import WeakSet

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_floats, require_shape
from ctxval._util.checked import NonNegativeFloat, PositiveInt, checked
from ctxval._util.cores import raised_by_signal
from ctxval._util.describe import describe, without_numbers
from ctxval._util.progress import advance
from ctxval._util.representation import call, name_of
from ctxval._util.texts import parted, reason_of
from ctxval.core.controller import Controller, Synthesizer, is_controller
from ctxval.core.distance import Distance
from ctxval.core.floating_base import Fall, UntilFall, until_fall
from ctxval.core.labels import Labels, names_of, require_names
from ctxval.core.model import Model, Step, as_model, require_time_step
from ctxval.core.plan import Outcome, Plan, ended_early, recorded_until_end, require_complete, require_execution
from ctxval.core.rollout import rollout
from ctxval.core.space import Parameters, TaskSpace
from ctxval.core.system import OutputsLike, Simulated, System, WithOutputs, as_outputs
from ctxval.core.task import Task
from ctxval.core.trajectory import COMPLETE, Trajectory
from ctxval.errors import CtxvalError, DesignError, DistanceError, ExecutionError, InputError, ModelError, ShapeError

START = 0.05  # default start tolerance, as a fraction of the range of each state in the trajectory of the model


class CostWarning(UserWarning):
    """A plan, or a search for d*, needs much time and memory."""


@checked
class Validation:
    """The map p -> d(p), made of a task space, a system, its model, a synthesizer and a distance.

    Args:
        space: the task space P.
        task: a function ``p -> Task``, which is called with the named parameters of one task or of a batch.
        system, model: the true system S, and the model M, which may be a function ``(x, u) -> x_next``.
        synthesizer: designs the controllers on M. If it has the condition of a ``fall``, a robot lies still from its
            fall on in all distances.
        distance: the distance d between the trajectories of M and S.
        start_tolerance: the largest permitted difference between the first state of an execution and the initial state
            of its task, as a fraction of the range of each state in the trajectory of the model, or of its initial
            value if that is larger. Four standard deviations of the noise that the record shows are permitted, too.
        labels: the names and units of states, inputs and distance for files, pictures and reports.
        longest: the largest horizon that is planned.
        physical: names of the task parameters that change the dynamics of S, such as a payload or a surface. What M
            misses is learned as a function of state, input and these parameters.
        outputs: a function ``h(x) -> y`` of M's states, or the indices of states, if S records outputs y in the place
            of states. Trajectories then have the outputs as their ``states``: controllers see them, distances and
            labels are about them, and goals and references of tasks are outputs. The initial state is one of M.

    Its methods raise a DesignError if the synthesizer fails, a ModelError if the model fails or its closed loop is not
    finite, an ExecutionError if the system fails or its result is not an execution of the task, and a DistanceError if
    the distance fails or is not a finite number >= 0.
    """

    cost_stated_from = 100_000  # horizon from which on the cost of a plan is stated before the first one

    def __init__(
        self,
        *,
        space: TaskSpace,
        task: Callable[[Parameters], Task],
        system: System,
        model: Model | Step,
        synthesizer: Synthesizer,
        distance: Distance,
        start_tolerance: NonNegativeFloat = START,
        labels: Labels | None = None,
        longest: PositiveInt = 1_000_000,
        physical: Sequence[str] = (),
        outputs: OutputsLike | None = None,
    ) -> None:
        self.space = space
        self.task = task
        self.system = system
        self.model = as_model(model)
        self.synthesizer = synthesizer
        self.labels = Labels() if labels is None else labels
        states = self.labels.states or tuple(names_of(system, "states"))
        require_names(states, self.labels.inputs or names_of(system, "inputs"))
        named = getattr(distance, "with_states", None)
        if callable(named):
            distance = named(tuple(parted(label)[0] for label in states))
        self.outputs = as_outputs(outputs)
        turning = getattr(distance, "with_quaternions", None)
        if callable(turning):
            distance = turning(self.outputs.geometry(self.model).quaternions)
        self.distance: Distance = until_fall(distance, synthesizer)
        self.start_tolerance = float(start_tolerance)
        self.longest = int(longest)
        self.physical = tuple(dict.fromkeys(physical))
        for name in self.physical:
            space.columns(name)

    def describe(self) -> dict[str, Any]:
        """Return what identifies this validation in a store."""
        parts = {part: describe(getattr(self, part)) for part in ("space", "task", "system", "synthesizer", "distance")}
        if self.outputs.hide_states:
            parts["outputs"] = describe(self.outputs)
        # The numbers of M are learned: its closed loops show whether it is the same.
        return {**parts, "model": without_numbers(describe(self.model))}

    def on_model(self, distance: Distance, *, units: str | None = None) -> Validation:
        """Return this validation with M itself in the place of S, which is never executed (the paper's Aspect 1).

        The distance, with its units, is how far M is from completing its task, as :class:`ctxval.distances.GoalError`.
        """
        labels = self.labels if units is None else replace(self.labels, units=units)
        system = self.outputs.recording(Simulated(self.model))
        return self.with_parts(system=system, distance=distance, labels=labels, start_tolerance=START)

    @property
    def is_on_model(self) -> bool:
        """Whether M itself is in the place of S."""
        system = self.system.system if isinstance(self.system, WithOutputs) else self.system
        return isinstance(system, Simulated) and system.model is self.model

    def recorded(self, x: Array) -> Array:
        """Return what is recorded in states of M ``(..., n)``: their outputs if there are any, or these states."""
        return self.outputs(x)

    def require_states(self, what: str) -> None:
        """Refuse outputs in the place of states for what needs recorded states of M.

        Raises:
            InputError: if outputs are recorded.
        """
        if self.outputs.hide_states:
            raise InputError(f"{what} needs recorded states of M, and this validation records outputs h(x) of them.")

    def require_goal(self, task: Task) -> None:
        """Refuse a task whose goal or reference has other components than what is recorded."""
        with _failing_as(InputError, "the outputs h(x)"):
            width = self.recorded(task.initial_state).shape[-1]
        task.require_width(width, self.outputs.name)

    def recorded_task(self, task: Task) -> Task:
        """Return a task as who executes it knows it: with the outputs of its initial state, if there are any."""
        return task.starting_at(self.recorded(task.initial_state))

    def closed_loop(self, controller: Controller, task: Task) -> Trajectory:
        """Return the closed loop of a controller with M, as it is recorded."""
        return self.outputs.of(rollout(self.model, self.outputs.seen_by(controller), task))

    def with_parts(self, **changed: Any) -> Validation:
        """Return this validation with other arguments, such as another ``model``, ``distance`` or ``space``."""
        return Validation(**{**vars(self), **changed})

    def names(self, states: int, inputs: int) -> tuple[dict[str, str], dict[str, str]]:
        """Return the names of n states and m inputs with their units (:meth:`Labels.names`)."""
        return self.labels.names(self.system, states, inputs)

    # The heart of the loop, for one task: plan, execute, accept

    def plan(self, point: ArrayLike) -> Plan:
        """Design the controller for the task at ``(d,)`` and run it on the model; S is not executed.

        Raises:
            ModelError: if the model does not predict the task.
            ShapeError: if the task is a batch.
        """
        parameters = self.space.parameters(point)
        try:
            plan = self.plan_of(parameters, self.task_at(parameters))
        except (DesignError, ModelError) as error:
            where = self.space.describe_point(parameters.points)
            raise type(error)(f"{str(error).removesuffix('.')} (task {where}).") from error
        if plan.task.batch_shape:
            raise ShapeError(f"the task function made a batch of shape {plan.task.batch_shape} of one point.")
        run = plan.model_trajectory
        if not run.predicts:
            where = self.space.describe_point(parameters.points)
            ended = f"the model's closed loop {run.ended} for the task {where}"
            raise ModelError(f"{ended}: repair the model, or restrict the task space to tasks that it can perform.")
        run = run if run.finite else run.first(int(run.lengths))
        return replace(plan, model_trajectory=run.frozen())

    def execute(self, plan: Plan) -> Trajectory:
        """Execute S once.

        Raises:
            ExecutionError: if the system fails.
        """
        try:
            trajectory = self.system.execute(plan.controller, plan.task)
        except BaseException as error:
            if raised_by_signal(error):
                raise
            raise ExecutionError(reason_of(error)) from error
        try:
            return self.require(plan, trajectory)
        except InputError as error:
            raise ExecutionError(str(error)) from error

    def require(self, plan: Plan, trajectory: object, start_tolerance: float | None = None) -> Trajectory:
        """Return a trajectory that is a complete and finite execution of a plan; refuse any other.

        If the closed loops of both M and S ended early, by a fall or an instability, or that of S at a fall that the
        synthesizer knows, it is the steps before. If only one of them did otherwise, there is no distance. A start
        tolerance replaces that of this validation.

        Raises:
            ExecutionError: if the result is no complete and finite trajectory of the task.
            InputError: if it belongs to another task.
        """
        tolerance = self.start_tolerance if start_tolerance is None else start_tolerance
        if not isinstance(trajectory, Trajectory):
            raise ExecutionError(f"the system returned {type(trajectory).__name__} instead of a Trajectory")
        if (wanted := plan.task.initial_state).shape == trajectory.states.shape[-1:]:
            geometry = self.outputs.geometry(self.model)
            if geometry.quaternions and trajectory.states.ndim == 2:
                trajectory = replace(trajectory, states=geometry.continued(trajectory.states, wanted))
        if ended_early(plan, trajectory) and (plan.model_trajectory.ended != COMPLETE or self.falls(trajectory)):
            return recorded_until_end(plan, trajectory, tolerance)
        require_complete(plan, trajectory)
        require_execution(plan, trajectory, tolerance)
        return trajectory

    def falls(self, trajectory: Trajectory) -> bool:
        """Return whether the robot of a trajectory falls, by the condition that the synthesizer knows."""
        return self.fall is not None and self.fall.seconds(trajectory) is not None

    @property
    def fall(self) -> Fall | None:
        """The condition of a fall that the synthesizer knows; None if it knows none."""
        return self.distance.fall if isinstance(self.distance, UntilFall) else None

    def accept(self, plan: Plan, trajectory: object, start_tolerance: float | None = None) -> float:
        """Check that a trajectory is an execution of a plan, as :meth:`require` does, and return its distance.

        This is the single check for all executions: of a system, of workers, and recordings of users.
        """
        return self.measure(plan, self.require(plan, trajectory, start_tolerance))

    def measure(self, plan: Plan, trajectory: Trajectory) -> float:
        """Return d(p)."""
        value = self.distance_between(plan.model_trajectory, trajectory, plan.task)
        return self._measured(plan.parameters.points, value)

    def remeasure(self, point: ArrayLike, model_trajectory: Trajectory, system_trajectory: Trajectory) -> float:
        """Return d(p) at ``(d,)`` between known trajectories, as :meth:`measure` does; no controller is designed."""
        parameters = self.space.parameters(point)
        value = self.distance_between(model_trajectory, system_trajectory, self.task_at(parameters))
        return self._measured(parameters.points, value)

    def _measured(self, point: Array, value: Array) -> float:
        if value.shape != () or not np.isfinite(value) or value < 0:
            where, got = self.space.describe_point(point), value if value.shape == () else f"an array {value.shape}"
            raise DistanceError(f"the distance must be one finite number >= 0, got {got} for the task {where}.")
        return float(value)

    def outcome(self, point: ArrayLike) -> Outcome:
        """Plan, execute and measure the task at ``(d,)``."""
        plan = self.plan(point)
        trajectory = self.execute(plan)
        return Outcome(plan, trajectory, self.measure(plan, trajectory))

    # Many tasks

    @property
    def batched(self) -> bool:
        """Whether system and synthesizer take a batch of tasks in one call."""
        return bool(getattr(self.system, "batched", False) and getattr(self.synthesizer, "batched", False))

    def plans(self, points: ArrayLike) -> list[Plan]:
        """Return the plans of the tasks at ``(N, d)`` as :meth:`plan` does, but designed together if possible."""
        return list(self._planned(require_shape("points", as_floats("points", points), (self.space.dimension,))))

    def _planned(self, points: Array) -> Iterator[Plan]:
        together = getattr(self.synthesizer, "batched", False)
        for chunk in (points[first : first + 256] for first in range(0, len(points), 256)):  # more is hardly faster
            plans = list[Plan]()
            with suppress(Exception):  # the user's own parts, which need not take a batch
                if together and len(chunk) > 1:
                    parameters = self.space.parameters(chunk)
                    whole = self.plan_of(parameters, self.task_at(parameters))
                    if whole.task.batch_shape == (len(chunk),) and whole.model_trajectory.finite.all():
                        plans = [whole.of(k, self.space.parameters(point)) for k, point in enumerate(chunk)]
            divisible = bool(plans) and all(is_controller(plan.controller) for plan in plans)
            yield from plans if divisible else map(self.plan, chunk)

    def distances(self, points: ArrayLike) -> Array:
        """Return d at points ``(N, d)``, shape ``(N,)``; NaN if the execution fails. Executes S N times.

        Tasks are planned together if the synthesizer takes batches, and executed together if S does, too.
        """
        rows = require_shape("points", as_floats("points", points), (self.space.dimension,))
        if self.batched and len(rows):
            # 4096 tasks in one call: enough for speed, few enough for the memory.
            return np.concatenate([self._batch_distances(rows[i : i + 4096]) for i in range(0, len(rows), 4096)])
        return np.array([self._distance_or_nan(plan) for plan in self._planned(rows)])

    def distance_between(self, model: Trajectory, system: Trajectory, task: Task) -> Array:
        """Return the distance ``(...)`` of trajectories, which it may not change.

        If they ended early, it is over their common part: from then on, both hold their state.

        Raises:
            DistanceError: if the distance fails, or gives no real number.
        """
        if not task.batch_shape and min(model.horizon, system.horizon) < task.horizon and model.ended != COMPLETE:
            common = min(model.horizon, system.horizon)
            model, system = (run.held(common, task.times) for run in (model, system))
        try:
            with np.errstate(all="ignore"):  # some distances change the arrays that they are given
                values = as_floats("a distance", self.distance(model.copy(), system.copy(), task))
                return np.asarray(values + 0.0)  # -0.0 is 0.0
        except BaseException as error:
            if raised_by_signal(error):
                raise
            raise DistanceError(f"the distance failed: {reason_of(error).rstrip('.')}.") from error

    def _distance_or_nan(self, plan: Plan) -> float:
        try:
            trajectory = self.execute(plan)
        except ExecutionError:
            return np.nan
        finally:
            advance()
        return self.measure(plan, trajectory)

    def _batch_distances(self, points: Array) -> Array:
        parameters = self.space.parameters(points)
        plan = self.plan_of(parameters, self.task_at(parameters))
        if plan.task.batch_shape != (len(points),):
            got = f"got shape {plan.task.batch_shape}; use the parameters in the task, or broadcast them"
            raise ShapeError(f"the task function must make a batch of {len(points)} tasks of as many points, {got}.")
        expected = plan.model_trajectory
        if not expected.predicts.all():
            where = self.space.describe_point(points[np.argmin(expected.predicts)])
            raise ModelError(f"the model's closed loop is not finite for the task {where}.")
        if not expected.finite.all():  # each end is compared with that of the system
            return np.array([self._distance_or_nan(self.plan(point)) for point in points])
        try:
            trajectory = self.system.execute(plan.controller, plan.task)
        except Exception:  # only single executions show which task failed
            return np.array([self._distance_or_nan(self.plan(point)) for point in points])
        values = self.distance_between(expected, trajectory, plan.task)
        if values.shape != (len(points),):
            raise DistanceError(f"the distance must have shape ({len(points)},) over the batch, got {values.shape}.")
        fits = trajectory.states.shape == expected.states.shape and trajectory.inputs.shape == expected.inputs.shape
        # If the batch ended early but all its values are finite, it is not known which task ended early.
        known = fits and (trajectory.ended == COMPLETE or not trajectory.finite.all())
        executed = trajectory.finite if known else np.zeros(len(points), dtype=bool)
        wrong = executed & ~(np.isfinite(values) & (values >= 0))
        if wrong.any():
            self._measured(points[np.argmax(wrong)], values[np.argmax(wrong)])  # which refuses it
        advance(len(points))
        return np.where(executed, values, np.nan)

    # Used for one task and for many

    def plan_of(self, parameters: Parameters, task: Task) -> Plan:
        """Return the plan of a task, or of a batch, that is made already; :meth:`plan` checks more."""
        self.require_goal(task)
        with _failing_as(DesignError, "the synthesizer"):
            controller = self.synthesizer.design(task, self.model)
        if isinstance(controller, Synthesizer):  # its next design would change this one, before it is executed
            controller = copy(controller)
        with _failing_as(ModelError, "the closed loop on the model"):
            trajectory = self.closed_loop(controller, task)
        return Plan(parameters, task, controller, trajectory)

    def task_at(self, parameters: Parameters) -> Task:
        """Return the task that the task function makes, or a batch of them, after a check of what it returns.

        Raises:
            InputError: if the task function returns no task.
        """
        with _failing_as(InputError, "the task function"):
            task = self.task(parameters)
        if not isinstance(task, Task):
            raise InputError(f"the task function's result must be a Task, got {task!r}.")
        require_time_step(self.model, task.dt, "the task")
        if task.horizon > self.longest or (task.horizon > self.cost_stated_from and self not in _stated):
            self._state_cost(parameters, task)
        return self.space.named(task, parameters.points)

    def _state_cost(self, parameters: Parameters, task: Task) -> None:
        """State the cost of a long horizon once, from the first steps of a plan; refuse one that is too long."""
        steps, probed = task.horizon, min(100, task.horizon)
        start, reference, more = task.initial_state, task.reference[..., : probed + 1, :], task.environment
        first = Task(start, horizon=probed, dt=task.dt, reference=reference, environment=more)
        begun = time.process_time()
        trajectory = self.plan_of(parameters, first).model_trajectory
        seconds = (time.process_time() - begun) * steps / probed
        n, m = trajectory.states.shape[-1], trajectory.inputs.shape[-1]
        # Two trajectories, and the gains of affine feedback.
        size = 8e-9 * np.prod(task.batch_shape) * steps * (2 * (n + m) + n * m + m)
        needs = f"about {size:.2g} GB of memory and {seconds:.2g} s of CPU time"
        cost = f"each plan with a horizon of {steps} needs {needs}"
        if steps > self.longest:
            permit = f"longest = {steps} permits them, in Validation or in the experiment file"
            raise InputError(f"{cost}, and at most {self.longest} steps are permitted: {permit}.")
        _stated.add(self)
        warnings.warn(f"{cost}, and a simulated execution about as much.", CostWarning, stacklevel=2)

    def __repr__(self) -> str:
        parts = {name: name_of(type(getattr(self, name))) for name in ("system", "model", "synthesizer", "distance")}
        return call(self, self.space, **parts)


@contextmanager
def _failing_as(kind: type[CtxvalError], part: str) -> Iterator[None]:
    """Report any exception of a user's part as one of ctxval."""
    try:
        yield
    except CtxvalError:
        raise
    except (Exception, SystemExit) as error:
        raise kind(f"{part} failed: {reason_of(error)}.") from error


_stated: WeakSet[Validation] = WeakSet()  # the validations whose cost was stated
