"""The true system S. Only its executions are costly, and only they are counted."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from ctxval.core.controller import Controller
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
