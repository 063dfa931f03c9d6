"""Plain functions and people as the true system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from ctxval._util.arrays import as_floats
from ctxval._util.checked import Seconds
from ctxval._util.refusals import reworded
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller, Feedback, started
from ctxval.core.labels import require_names
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import ExecutionError, InputError


@part(functions={"execute": "(controller, task) -> trajectory"})
class Function(ShortRepr):
    """A plain function ``(controller, task) -> trajectory`` as the true system: a robot's own driver, a simulator.

    The function calls ``controller(t, x)`` for the inputs, once for each step in order if the controller has memory.
    It returns a trajectory, or the states ``(H + 1, n)`` and the inputs ``(H, m)``; a batched one takes a batch of
    tasks. If it raises an exception, the execution has failed for that reason. For a function of one step, ``(x, u) ->
    x_next``, use a :class:`Simulated` system.
    """

    def __init__(self, execute: Callable[[Feedback, Task], Any], *, batched: bool = False) -> None:
        self.function = execute
        self.batched = batched

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        returned = self.function(started(controller, task), task)
        if isinstance(returned, Trajectory):
            return returned
        wanted = f"a Trajectory, or states (H + 1, n) and inputs (H, m) with H = {task.horizon}"
        with reworded(f"the system's function must return {wanted}", TypeError, ValueError, to=ExecutionError):
            states, inputs = (as_floats(name, part) for name, part in zip(("states", "inputs"), returned, strict=True))
            return Trajectory(task.times, states, inputs)


@part()
class Manual(ShortRepr):
    """A system whose tasks people execute: get a task with ``campaign.ask()``, report it with ``campaign.tell()``.

    States and inputs are names of the components with their units, for files.
    """

    manual = True  #: mark of a system that a program cannot execute

    def __init__(self, *, states: Mapping[str, str], inputs: Mapping[str, str], dt: Seconds) -> None:
        self.states, self.inputs = dict(states), dict(inputs)
        if not self.states:
            raise InputError(f"states and inputs must be names with units, got {self.states} and {self.inputs}.")
        require_names(self.states, self.inputs)
        self.dt = float(dt)

    def execute(self, controller: Controller, task: Task) -> NoReturn:
        advice = "get a task with campaign.ask() and report its result with campaign.tell() instead of campaign.run()"
        raise ExecutionError(f"a manual system is executed by people; {advice}.")
