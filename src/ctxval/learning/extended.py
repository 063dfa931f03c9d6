"""The validation of which dynamics are learned: states of M for outputs, parameters as states, inputs that act.

What M misses must be a function of state and input. Task parameters may change the dynamics, as a payload does: each of
these becomes a state that does not change. If inputs have effects, such as a delay, executions have the inputs that act
in the place of commands. So everything that is learned, covered and tested of states and inputs holds. M, the
controllers and the distance are the user's, and see a closed loop as the system records it.
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval.core.controller import Controller, Synthesizer, seeing
from ctxval.core.distance import Distance
from ctxval.core.labels import Labels, labels_of
from ctxval.core.model import Model, advanced, memory_in
from ctxval.core.space import Parameters
from ctxval.core.system import Outputs
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.effects.inputs import NO_EFFECTS, InputEffects
from ctxval.learning.histories import Record
from ctxval.learning.prediction import Executed
from ctxval.learning.recorded import closed_loops_on_model, scheduled
from ctxval.learning.state_estimates import RecordedStates, StateEstimates, States


def with_states_of_model(validation: Validation) -> Validation:
    """Return a validation, not to be executed, whose trajectories have the states of M; itself if it records states."""
    if not validation.outputs.hide_states:
        return validation
    return ExtendedValidation(validation.with_parts(physical=())).validation


def estimates_by_loops_on_model(validation: Validation) -> States | None:
    """Return the states of M along executions of a validation; None if no task can be planned."""
    return ExtendedValidation(validation.with_parts(physical=())).estimates


class ExtendedValidation:
    """A user's validation, which is given, and the one whose trajectories what S does in a step is a function of.

    The system of the other ``validation`` cannot be executed. If nothing is extended, it is the given one.
    """

    def __init__(
        self,
        given: Validation,
        effects: InputEffects = NO_EFFECTS,
        estimates: States | None = None,
    ) -> None:
        self.given, self.effects, self._known = given, effects, estimates
        self._acting = WeakKeyDictionary[Trajectory, Trajectory]()
        of_names = (np.arange(given.space.dimension)[given.space.columns(name)] for name in given.physical)
        self._columns = np.hstack([np.empty(0, dtype=np.intp), *of_names])
        # Whether only executions of tasks can be learned from: other recordings tell no parameters and no start.
        changes = bool(given.physical) or given.outputs.hide_states
        self.needs_tasks = changes or bool(effects.effects)
        self.validation = self._extended() if changes else given

    def _extended(self) -> Validation:
        given, columns, k = self.given, self._columns, len(self._columns)

        def task(parameters: Parameters) -> Task:
            plain = given.task(parameters)
            return _ExtendedTask(plain, parameters.points[..., columns]) if k else plain

        # If only outputs are recorded, M is that of the user, and controllers are designed on the model that is given.
        model = _ExtendedModel(given.model, k) if k else None
        designed_on = None if model is None else given.model
        return given.with_parts(
            task=task,
            model=model or given.model,
            synthesizer=_ExtendedSynthesizer(given.synthesizer, designed_on, given.outputs, k),
            distance=_ExtendedDistance(given.distance, self.recorded),
            labels=self._labels(),
            outputs=None,
            physical=(),
        )

    def _labels(self) -> Labels:
        given, space, outputs = self.given, self.given.space, self.given.outputs
        labels = replace(given.labels, states=()) if outputs.hide_states else given.labels
        with contextlib.suppress(Exception):  # the user's task, which is planned with its own errors elsewhere
            n = given.task(space.parameters(0.5 * (space.low + space.high))).initial_state.shape[-1]
            if outputs.hide_states:
                names, recorded = [f"x{i}" for i in range(n)], outputs.indices or []
                for i, label in zip(recorded, labels_of(given.names(len(recorded), 0)[0]), strict=True):
                    names[i] = label
                labels = replace(labels, states=tuple(names))
            if len(self._columns):
                states, _ = labels.names(given.system, n, 0)
                parameters = [(space.names[i], space.labels[i]) for i in self._columns]
                more = (f"task {label}" if name in states else label for name, label in parameters)
                labels = replace(labels, states=(*labels_of(states), *more))
        return labels

    @property
    def parameters(self) -> int:
        """The number of task parameters that are states, the last ones."""
        return len(self._columns)

    @functools.cached_property
    def loops(self) -> Trajectory | None:
        """Closed loops on M, which took so many ``seconds``; None if no task can be planned."""
        with single_threaded():
            begun = time.perf_counter()
            loops = closed_loops_on_model(self.validation)
            self.seconds = time.perf_counter() - begun
        return loops

    @functools.cached_property
    def pairs(self) -> Array:
        """Some states and acting inputs of the closed loops on M, shape ``(V, n + m)``."""
        assert self.loops is not None
        pairs = np.concatenate([self.loops.states[..., :-1, :], self.effects.acting(self.loops.inputs)], axis=-1)
        pairs = pairs.reshape(-1, pairs.shape[-1])
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        return np.asarray(pairs[:: max(1, len(pairs) // 600)])

    def executions(self, executed: Executed, some: int | None = None) -> Executed | None:
        """Return executions of the other validation; None without states, estimated as in the first ``some``."""
        some = scheduled(len(executed)) if some is None else some
        acting = list(executed)
        if self.effects.effects:  # the same object each time
            for _, trajectory in executed:
                if trajectory not in self._acting:
                    self._acting[trajectory] = replace(trajectory, inputs=self.effects.acting(trajectory.inputs))
            acting = [(point, self._acting[trajectory]) for point, trajectory in executed]
        states = None if self.estimates is None else self.estimates.of(acting, some)
        if states is None:
            return None
        acting = [(point, trajectory) for (point, _), trajectory in zip(acting, states, strict=True)]
        if not len(self._columns):
            return acting
        values = [self.given.space.from_unit(point)[self._columns] for point, _ in acting]
        return [
            (point, replace(trajectory, states=_joined(trajectory.states, each)))
            for (point, trajectory), each in zip(acting, values, strict=True)
        ]

    def of(self, given: Validation) -> ExtendedValidation:
        """Return the same with other physical parameters; the states of M along executions are the same."""
        return ExtendedValidation(given, self.effects, self.estimates)

    @functools.cached_property
    def estimates(self) -> States | None:
        """The states of M along executions; None if they must be estimated and no task can be planned."""
        if not self.given.outputs.hide_states:
            return RecordedStates()
        if self.loops is None or self._known is not None:
            return self._known
        states = self.loops.states[..., : self.loops.states.shape[-1] - len(self._columns)]
        return StateEstimates(self.given, self.given.outputs, states)

    def recorded(self, trajectory: Trajectory) -> Trajectory:
        """Return a closed loop, with the inputs that are commanded, as the system records it."""
        if len(self._columns):
            trajectory = replace(trajectory, states=trajectory.states[..., : -len(self._columns)])
        return self.given.outputs.of(trajectory)

    def records(self, executed: Executed) -> list[Record]:
        """Return executions of the other validation with the inputs that act, and the initial states of their tasks."""
        space, records = self.validation.space, []
        for point, trajectory in executed:
            task = self.validation.task(space.parameters(space.from_unit(point)))
            start = np.asarray(task.initial_state, dtype=np.float64)
            records.append(Record(trajectory.states, trajectory.inputs, start))
        return records


def _joined(states: Array, values: Array) -> Array:
    return np.concatenate([states, np.broadcast_to(values, (*states.shape[:-1], values.shape[-1]))], axis=-1)


class _ExtendedTask(Task):
    """A task with values ``(..., k)`` as further states, which it keeps."""

    def __init__(self, plain: Task, values: Array) -> None:
        self.plain, self.values = plain, values
        reference = _joined(plain.reference, values[..., None, :]) if plain.has_goal else None
        start = _joined(plain.initial_state, values)
        more = {"name": plain.name, "environment": plain.environment}
        super().__init__(start, horizon=plain.horizon, dt=plain.dt, reference=reference, **more)

    def __getitem__(self, index: int | slice) -> Task:
        return _ExtendedTask(self.plain[index], self.values[index])

    def named(self, name: Any) -> Task:
        return _ExtendedTask(self.plain.named(name), self.values)

    def starting_at(self, states: Array) -> Task:
        k = self.values.shape[-1]
        return _ExtendedTask(self.plain.starting_at(states[..., :-k]), states[..., -k:])


def _plain(task: Task) -> Task:
    return task.plain if isinstance(task, _ExtendedTask) else task


@dataclass(frozen=True)
class _ExtendedModel:
    """M, beside k states that stay as they are."""

    model: Model
    k: int

    def step(self, x: Array, u: Array) -> Array:
        n = x.shape[-1] - self.k
        return _joined(np.asarray(self.model.step(x[..., :n], u)), x[..., n:])

    def start(self, x: Array) -> Array:
        return memory_in(self.model, x[..., : x.shape[-1] - self.k])

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        n = x.shape[-1] - self.k
        following, memory = advanced(self.model, x[..., :n], u, memory)
        return _joined(following, x[..., n:]), memory


@dataclass(frozen=True)
class _ExtendedSynthesizer:
    """Designs the user's controllers, on this model if it is given; they see what is recorded."""

    synthesizer: Synthesizer
    model: Model | None
    outputs: Outputs
    k: int

    @property
    def batched(self) -> bool:
        return bool(getattr(self.synthesizer, "batched", False))

    def design(self, task: Task, model: Model) -> Controller:
        designed = self.synthesizer.design(_plain(task), model if self.model is None else self.model)
        controller = self.outputs.seen_by(designed)
        return seeing(controller, lambda x: x[..., : -self.k], _plain) if self.k else controller


@dataclass(frozen=True)
class _ExtendedDistance:
    """The user's distance of what the system records."""

    distance: Distance
    recorded: Callable[[Trajectory], Trajectory]

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        return self.distance(self.recorded(model_trajectory), self.recorded(system_trajectory), _plain(task))
