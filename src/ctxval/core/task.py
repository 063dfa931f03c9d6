"""Control tasks: an initial state, a reference, a horizon and a time step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, as_finite, as_floats, read_only
from ctxval._util.checked import PositiveInt, Seconds, checked
from ctxval._util.representation import call
from ctxval.errors import InputError, ShapeError

COMMAND = "command"  #: the entry of the environment that is the command


@checked
class Task:
    """One control task, or a batch of them.

    Args:
        initial_state: the first state: n components, each a number or an array ``(...)`` over the batch; or an array
            ``(..., n)``.
        horizon: number of steps H.
        dt: length of a step, seconds.
        goal: the state to reach, given like ``initial_state``; a goal is a constant reference. If the validation has
            outputs, it is the outputs to reach, and has their number.
        reference: the states, or outputs, to follow, array ``(..., H + 1, n)``; give this or ``goal``, not both.
        name: the name of the task, or an array of names over the batch. A task of a :class:`ctxval.TaskSuite` gets
            that of the suite.
        environment: what else a design, a distance or a specification reads, such as the place of an obstacle: names
            with lists of numbers, each given like ``initial_state`` and with a width of its own.
        command: what a policy is told to do, such as velocities: the entry ``command`` of the environment.

    Raises:
        InputError: if numbers are not finite, or if a goal and a reference, or two commands are given.
        ShapeError: if the shapes do not belong together.
    """

    def __init__(
        self,
        initial_state: Any,
        *,
        horizon: PositiveInt,
        dt: Seconds,
        goal: Any = None,
        reference: Any = None,
        name: Any = "",
        environment: Mapping[str, Any] | None = None,
        command: Any = None,
    ) -> None:
        if goal is not None and reference is not None:
            raise InputError("a task must have a goal or a reference, not both.")
        self.horizon = int(horizon)
        self.dt = float(dt)
        state = _components("initial_state", initial_state)
        n = state.shape[-1]
        if goal is not None:
            target = _components("goal", goal)[..., None, :]
        elif reference is not None:
            target = read_only(as_floats("reference", reference))
            if target.ndim < 2 or target.shape[-2] != self.horizon + 1:
                raise ShapeError(f"reference must have shape (..., {self.horizon + 1}, {n}), got {target.shape}.")
        else:
            target = np.zeros((1, n))
        if not (np.isfinite(state).all() and np.isfinite(target).all()):
            raise InputError("a task must have a finite initial_state and a finite goal or reference.")
        entries = dict(environment or {})
        if command is not None:
            if COMMAND in entries:
                raise InputError("a task must have one command, and its environment has another one.")
            entries[COMMAND] = command
        around = {key: _components(f"environment {key!r}", given) for key, given in entries.items()}
        for key, given in around.items():
            as_finite(f"environment {key!r}", given)
        shapes = [given.shape[:-1] for given in around.values()]
        try:
            self.batch_shape: tuple[int, ...] = np.broadcast_shapes(state.shape[:-1], target.shape[:-2], *shapes)
        except ValueError:
            also = " and environment" if around else ""
            got = " and ".join(map(str, (target.shape[:-2], state.shape[:-1], *shapes)))
            raise ShapeError(
                f"goal or reference and initial_state{also} must have the same batch shape, got {got}."
            ) from None
        self.initial_state: Array = np.broadcast_to(state, (*self.batch_shape, n))
        """Shape ``(..., n)``."""
        self.reference: Array = np.broadcast_to(target, (*self.batch_shape, self.horizon + 1, target.shape[-1]))
        """Shape ``(..., H + 1, n)``; all zero if the task has neither goal nor reference."""
        self.has_goal: bool = goal is not None or reference is not None
        """Whether a goal or a reference was given."""
        self.repetition = 0
        """How often its campaign executed the same task before; of a batch 0."""
        self.name: Any = name
        """The name of the task, or those of a batch, ``(...)``; empty if it has none."""
        self.environment: dict[str, Array] = {
            key: np.broadcast_to(given, (*self.batch_shape, given.shape[-1])) for key, given in around.items()
        }
        """What else is known of the task, by name, arrays ``(..., k)``; empty if nothing is."""

    @property
    def goal(self) -> Array:
        """The last state of the reference, shape ``(..., n)``."""
        return self.reference[..., -1, :]

    @property
    def command(self) -> Array:
        """The command, shape ``(..., k)``.

        Raises:
            InputError: if the task has none.
        """
        if COMMAND not in self.environment:
            raise InputError("the task must have a command, as in Task(..., command=[0.5, 0.0, 0.2]).")
        return self.environment[COMMAND]

    @property
    def times(self) -> Array:
        """The times of the states, shape ``(H + 1,)``, seconds."""
        return np.asarray(np.arange(self.horizon + 1) * self.dt)

    def require_width(self, width: int, like: str = "its initial_state") -> None:
        """Refuse a goal or a reference that has another number of components than what it is compared with.

        Raises:
            ShapeError: if the goal or reference has another number of components.
        """
        got = self.reference.shape[-1]
        if self.has_goal and got != width:
            raise ShapeError(f"the goal or reference of a task must have {width} components, as {like}, got {got}.")

    @staticmethod
    def stacked(tasks: Sequence[Task]) -> Task:
        """Return single tasks with one horizon and one time step as a batch."""
        first, names = tasks[0], [task.name for task in tasks]
        starts, references = (np.stack([getattr(task, of) for task in tasks]) for of in ("initial_state", "reference"))
        around = {key: np.stack([task.environment[key] for task in tasks]) for key in first.environment}
        return first._like(starts, references, np.array(names) if any(names) else "", around)

    def __getitem__(self, index: int | slice) -> Task:
        """Return one task of the batch, or some of them."""
        names = np.broadcast_to(self.name, self.batch_shape)
        around = {key: given[index] for key, given in self.environment.items()}
        return self._like(self.initial_state[index], self.reference[index], names[index], around)

    def starting_at(self, states: Array) -> Task:
        """Return the task from other initial states ``(..., n)``, which may have further axes in front."""
        return self._like(states, self.reference, self.name, self.environment)

    def named(self, name: Any) -> Task:
        """Return the task with a name, or a batch with an array of names."""
        return self._like(self.initial_state, self.reference, name, self.environment)

    def again(self, repetition: int) -> Task:
        """Return the task as it is executed after so many executions of it."""
        task = self._like(self.initial_state, self.reference, self.name, self.environment)
        task.repetition = repetition
        return task

    def _like(self, initial_state: Array, reference: Array, name: Any, environment: Mapping[str, Array]) -> Task:
        name = name if np.ndim(name) else str(name)
        aim = reference if self.has_goal else None
        return Task(initial_state, horizon=self.horizon, dt=self.dt, reference=aim, name=name, environment=environment)

    def describe(self) -> dict[str, Any]:
        """Return what identifies one task in a store."""
        about = {"horizon": self.horizon, "dt": self.dt, "initial_state": self.initial_state.tolist()}
        more = {"name": self.name, "environment": self.environment}
        return about | {"reference": self.reference} | {key: value for key, value in more.items() if value}

    def __repr__(self) -> str:
        if self.batch_shape:
            sizes = {"batch": self.batch_shape, "states": self.initial_state.shape[-1]}
            return call(self, **sizes, horizon=self.horizon, dt=self.dt)
        aim = {"goal": self.goal} if (self.reference == self.goal).all() else {"reference": self.reference}
        about = {"initial_state": self.initial_state, **aim, "environment": self.environment or None}
        return call(self, name=self.name or None, **about, horizon=self.horizon, dt=self.dt)


def _components(name: str, value: Any) -> Array:
    if isinstance(value, list | tuple) and len(value):
        parts = [as_floats(f"{name}[{i}]", part) for i, part in enumerate(value)]
        try:
            return np.stack(np.broadcast_arrays(*parts), axis=-1)
        except ValueError:
            shapes = [part.shape for part in parts]
            raise ShapeError(f"the components of {name} must have the same batch shape, got {shapes}.") from None
    array = read_only(as_floats(name, value))
    if array.ndim == 0 or array.size == 0:
        raise ShapeError(f"{name} must be a list of components or an array (..., n), got {value!r}.")
    return array
