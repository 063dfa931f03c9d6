"""Task parameters that change the dynamics of the system, such as a payload or a surface.

What M misses is then no function of state and input alone. Each such parameter becomes a state that does not change, so
everything that is learned, covered and tested of states holds for it too. M, the controllers and the distance are those
of the user and never see it.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.controller import Controller, ControllerWithMemory, Synthesizer
from ctxval.core.distance import Distance
from ctxval.core.labels import labels_of
from ctxval.core.model import Model
from ctxval.core.space import Parameters
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation


def with_parameters_as_states(validation: Validation) -> Validation:
    """Return a validation whose last states are the physical parameters; itself if there are none.

    Its system is that of the given one, and cannot be executed.
    """
    if not validation.physical:
        return validation
    space, labels = validation.space, validation.labels

    def task(parameters: Parameters) -> Task:
        return _ExtendedTask(validation.task(parameters), parameters.points[..., columns])

    columns = _columns(validation)
    with contextlib.suppress(Exception):  # the user's task, which is planned with its own errors elsewhere
        n = validation.task(space.parameters(0.5 * (space.low + space.high))).initial_state.shape[-1]
        states, _ = validation.names(n, 0)
        own = (f"task {space.labels[i]}" if space.names[i] in states else space.labels[i] for i in columns)
        labels = replace(labels, states=(*labels_of(states), *own))
    return validation.with_parts(
        task=task,
        model=_ExtendedModel(validation.model, len(columns)),
        synthesizer=_ExtendedSynthesizer(validation.synthesizer, validation.model),
        distance=_ExtendedDistance(validation.distance, len(columns)),
        labels=labels,
        physical=(),
    )


def with_parameters(validation: Validation, point: Array, trajectory: Trajectory) -> Trajectory:
    """Return a trajectory of a task, a point ``(d,)`` of the unit cube, with the physical parameters as last states."""
    if not validation.physical:
        return trajectory
    values = validation.space.from_unit(point)[_columns(validation)]
    return replace(trajectory, states=_joined(trajectory.states, values))


def without_parameters(validation: Validation, trajectory: Trajectory) -> Trajectory:
    """Return a trajectory without the states that :func:`with_parameters` adds."""
    return _cut(trajectory, added_states(validation)) if validation.physical else trajectory


def added_states(validation: Validation) -> int:
    """Return the number of states that are physical parameters."""
    return len(_columns(validation))


def _columns(validation: Validation) -> list[int]:
    d = validation.space.dimension
    return [int(i) for name in validation.physical for i in np.atleast_1d(np.arange(d)[validation.space.columns(name)])]


def _joined(states: Array, values: Array) -> Array:
    return np.concatenate([states, np.broadcast_to(values, (*states.shape[:-1], values.shape[-1]))], axis=-1)


def _cut(trajectory: Trajectory, k: int) -> Trajectory:
    return replace(trajectory, states=trajectory.states[..., :-k])


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


@dataclass(frozen=True)
class _ExtendedModel:
    """M, beside k states that stay as they are."""

    model: Model
    k: int

    def step(self, x: Array, u: Array) -> Array:
        return _joined(np.asarray(self.model.step(x[..., : -self.k], u)), x[..., -self.k :])


@dataclass(frozen=True)
class _ExtendedSynthesizer:
    """Designs the user's controllers on the user's model."""

    synthesizer: Synthesizer
    model: Model

    @property
    def batched(self) -> bool:
        return bool(getattr(self.synthesizer, "batched", False))

    def design(self, task: Task, model: Model) -> Controller:
        assert isinstance(task, _ExtendedTask)
        controller, k = self.synthesizer.design(task.plain, self.model), task.values.shape[-1]
        if isinstance(controller, ControllerWithMemory):
            return _ExtendedController(controller, k)
        return lambda t, x: controller(t, x[..., :-k])


@dataclass(frozen=True)
class _ExtendedController:
    """A controller with memory that sees all states but the last k."""

    controller: ControllerWithMemory
    k: int

    def start(self, task: Task) -> Any:
        return self.controller.start(task.plain if isinstance(task, _ExtendedTask) else task)

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        return self.controller.step(t, x[..., : -self.k], memory)


@dataclass(frozen=True)
class _ExtendedDistance:
    """The user's distance of the states without the last k."""

    distance: Distance
    k: int

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        plain = task.plain if isinstance(task, _ExtendedTask) else task
        return self.distance(_cut(model_trajectory, self.k), _cut(system_trajectory, self.k), plain)
