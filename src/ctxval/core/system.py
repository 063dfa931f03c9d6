"""The true system S, of which only the executions are costly and counted; and a step function in its place."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Function, Model, Step
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory


@runtime_checkable
class System(Protocol):
    """The true system S: hardware, a simulator, a function.

    A system that can execute a batch of tasks in one call has an attribute ``batched = True``.
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
        self.model = step if isinstance(step, Model) else Function(step, vectorized=vectorized)

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the initial state of the task over its horizon."""
        return rollout(self.model.step, controller, task)
