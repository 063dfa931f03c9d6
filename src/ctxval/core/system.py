"""The true system S, of which only the executions are costly and counted; and a step function in its place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Model, Step, as_model
from ctxval.core.outputs import Outputs, OutputsLike
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory


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
        """Run the closed loop from the initial state of the task over its horizon."""
        return rollout(self.model.step, controller, task)


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
