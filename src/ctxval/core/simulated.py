"""A system that is a step function on this computer."""

from __future__ import annotations

from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Function, Model, Step
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory


@part(functions={"step": "(x, u) -> x_next"})
class Simulated(ShortRepr):
    """A step function, or a model, as the true system.

    Args:
        step: function ``(x, u) -> x_next``, or an object with such a method ``step`` that takes batches.
        vectorized: whether a plain function takes whole batches ``(..., n)`` and ``(..., m)``.
    """

    batched = True

    def __init__(self, step: Step | Model, *, vectorized: bool = False) -> None:
        self.model = step if isinstance(step, Model) else Function(step, vectorized=vectorized)

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the task's initial state over its horizon."""
        return rollout(self.model.step, controller, task)
