"""A system whose tasks people execute by hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NoReturn

from ctxval._util.checked import Seconds
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.labels import require_names
from ctxval.core.task import Task
from ctxval.errors import ExecutionError, InputError


@part()
class Manual(ShortRepr):
    """A system whose tasks people execute: get a task with ``campaign.ask()``, report it with ``campaign.tell()``.

    States and inputs are names of the components with their units, for files.
    """

    manual = True
    """Mark of a system that a program cannot execute."""

    def __init__(self, *, states: Mapping[str, str], inputs: Mapping[str, str], dt: Seconds) -> None:
        self.states, self.inputs = dict(states), dict(inputs)
        texts = [*self.states.items(), *self.inputs.items()]
        if not self.states or not all(isinstance(text, str) for pair in texts for text in pair):
            raise InputError(f"states and inputs must be names with units, got {self.states} and {self.inputs}.")
        require_names(self.states, self.inputs)
        self.dt = float(dt)

    def execute(self, controller: Controller, task: Task) -> NoReturn:
        advice = "get a task with campaign.ask() and report its result with campaign.tell() instead of campaign.run()"
        raise ExecutionError(f"a manual system is executed by people; {advice}.")
