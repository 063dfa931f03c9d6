"""The true system S, of which only the executions are costly and counted: step functions in its place, its outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array, as_floats, rows_of
from ctxval._util.checked import require
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller, seeing
from ctxval.core.model import Model, Step, as_model, central_differences
from ctxval.core.rollout import rollout
from ctxval.core.state_geometry import PLAIN, StateGeometry, geometry_of
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError

OutputsLike = Callable[[Array], Array] | Sequence[int]
"""A function ``h(x) -> y`` of states ``(..., n)`` to outputs ``(..., p)``, or the indices of the states to record."""


class Outputs(ShortRepr):
    """The outputs y = h(x) of states of M, shapes ``(..., n) -> (..., p)``.

    A function that takes one state ``(n,)`` at a time is called once for each.
    """

    hide_states: ClassVar[bool] = True
    """Whether states of M are not recorded, so that they must be estimated."""

    name: ClassVar[str] = "the outputs"
    """What goals and references are compared with, in error messages."""

    def __init__(self, given: OutputsLike) -> None:
        if callable(given):
            self.function: OutputsLike = given
        else:
            self.function = [int(i) for i in require("outputs", Sequence[int], given)]
            if not self.function or len(set(self.function)) < len(self.function) or min(self.function) < 0:
                raise InputError(f"outputs must be a function h(x), or different indices of states, got {given!r}.")
        self._batched: bool | None = None

    def describe(self) -> dict[str, Any]:
        """Return what identifies these outputs in a store."""
        return {"of": self.function}

    @property
    def indices(self) -> list[int] | None:
        """The indices of the states that are recorded; None if a function gives the outputs."""
        return None if callable(self.function) else list(self.function)

    def __call__(self, x: Array) -> Array:
        """Return outputs ``(..., p)`` of states ``(..., n)``."""
        x = np.asarray(x, dtype=np.float64)
        if not callable(self.function):
            if max(self.function) >= x.shape[-1]:
                raise InputError(f"outputs must be indices of M's {x.shape[-1]} states, got {list(self.function)}.")
            return x[..., self.function]
        if x.ndim == 1:
            return self._of_one(x)
        rows = rows_of(x)
        if self._batched is None and len(rows):
            # Whether the function returns for a batch what it returns for its first and last state alone.
            ends, self._batched = [self._of_one(row) for row in (rows[0], rows[-1])], False
            with suppress(Exception):  # the user's function, which may take one state only
                y = as_floats("outputs", self.function(x))
                if y.shape == (*x.shape[:-1], *ends[0].shape):
                    self._batched = bool(np.allclose(rows_of(y)[[0, -1]], ends, rtol=1e-9, atol=0, equal_nan=True))
        if self._batched:
            return as_floats("outputs", self.function(x))
        return np.stack([self._of_one(row) for row in rows]).reshape(*x.shape[:-1], -1)

    def _of_one(self, x: Array) -> Array:
        assert callable(self.function)
        y = as_floats("outputs", self.function(x))
        if y.ndim != 1 or not y.size:
            raise ShapeError(f"outputs of one state must have shape (p,), got {y.shape} for a state {x.shape}.")
        return y

    def jacobian(self, x: Array) -> Array:
        """Return C = dh/dx, shape ``(..., p, n)``, at states ``(..., n)``."""
        n = x.shape[-1]
        if not callable(self.function):
            C = np.eye(n)[self.function]
            return np.broadcast_to(C, (*x.shape[:-1], *C.shape))
        return central_differences(lambda states, _: self(states), x, np.zeros((*x.shape[:-1], 0)))[0]

    def of(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory with its outputs in the place of states."""
        with np.errstate(all="ignore"):  # of a loop that diverged
            return replace(trajectory, states=self(trajectory.states))

    def seen_by(self, controller: Controller, task: Task | None = None) -> Controller:
        """Return a controller of the states for a controller that sees the outputs alone.

        A task is the one from which a controller with memory starts, if the states are not those of M.
        """
        return seeing(controller, self, lambda given: given if task is None else task)

    def recording(self, system: System) -> System:
        """Return a system that records these outputs, in the place of one that records states."""
        return WithOutputs(system, self)

    def geometry(self, model: Model) -> StateGeometry:
        """Return the geometry of what is recorded of a model's states."""
        return PLAIN


class AllStates(Outputs):
    """The states themselves, if all of them are recorded."""

    hide_states = False
    name = "its initial_state"

    def __init__(self) -> None:
        super().__init__(np.asarray)

    def __call__(self, x: Array) -> Array:
        return x

    def of(self, trajectory: Trajectory) -> Trajectory:
        return trajectory

    def seen_by(self, controller: Controller, task: Task | None = None) -> Controller:
        return controller

    def recording(self, system: System) -> System:
        return system

    def geometry(self, model: Model) -> StateGeometry:
        return geometry_of(model)


ALL_STATES = AllStates()


def as_outputs(given: OutputsLike | Outputs | None) -> Outputs:
    """Return outputs from any form in which users may give them; None means all states."""
    return ALL_STATES if given is None else given if isinstance(given, Outputs) else Outputs(given)


@runtime_checkable
class System(Protocol):
    """The true system S: hardware, a simulator, a function.

    A system that can execute a batch of tasks in one call has an attribute ``batched = True``. If each trajectory of a
    batch is also to the last digit that of its task alone, ``exact_batches = True`` lets campaigns execute tasks
    together that depend on no result.
    """

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the controller on the task, from the task's initial state to its horizon.

        Raises:
            Exception: if the execution fails; a campaign records it as a failed trial with its reason.
        """


@part(functions={"step": "(x, u) -> x_next"})
class Simulated(ShortRepr):
    """A step function ``(x, u) -> x_next``, or a model, as the true system.

    An object with a method ``step`` takes batches; a plain function does so if it is ``vectorized``.
    """

    batched = True

    def __init__(self, step: Step | Model, *, vectorized: bool = False) -> None:
        self.model = as_model(step, vectorized=vectorized)

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the initial state of the task over its horizon.

        If a step of one task raises an exception, the trajectory ends before it.
        """
        return rollout(self.model, controller, task, partial=not task.batch_shape)


@part(functions={"outputs": "x -> y", "start": "x -> first state"}, parts={"system": "system"})
class WithOutputs(ShortRepr):
    """A system whose controllers see outputs of its states, and that records them in the place of states.

    Args:
        system: the system with all its states.
        outputs: a function ``h(x) -> y`` of these states, or the indices of those that are recorded.
        start: the system's first state ``(..., s)`` for the initial state ``(..., n)`` of a task, which is one of M, if
            the two have other states.
    """

    def __init__(self, system: System, outputs: OutputsLike, *, start: Callable[[Array], Array] | None = None) -> None:
        self.system, self.outputs, self.start = system, Outputs(outputs), start

    @property
    def batched(self) -> bool:
        """Whether the system takes a batch of tasks in one call."""
        return bool(getattr(self.system, "batched", False))

    @property
    def exact_batches(self) -> bool:
        """Whether outputs in a batch are to the last digit those of each task alone, which functions do not promise."""
        functions = self.outputs.indices is None or self.start is not None
        return not functions and bool(getattr(self.system, "exact_batches", False))

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Execute the system, and return the inputs and outputs."""
        of_system = task
        if self.start is not None:
            of_system = task.starting_at(np.asarray(self.start(task.initial_state), dtype=np.float64))
        return self.outputs.of(self.system.execute(self.outputs.seen_by(controller, task), of_system))
