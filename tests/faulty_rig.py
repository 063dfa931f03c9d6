"""A system that fails at chosen executions."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Literal

import numpy as np

from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.system import System
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory

Fault = Literal["raise", "nan", "short", "wrong shape"]


class FaultyRig(ShortRepr):
    """A system that runs another one and fails at chosen executions, for tests of how a campaign handles failures.

    Args:
        faults: the fault of each execution that fails, by its number from 0: ``"raise"``, ``"nan"`` (all states are
            NaN), ``"short"`` (the last step is missing) or ``"wrong shape"`` (all states but the first are missing).
        delay: seconds to wait before each execution.
    """

    def __init__(self, system: System, faults: Mapping[int, Fault] | None = None, delay: float = 0.0) -> None:
        self.system = system
        self.faults = dict(faults or {})
        self.delay = delay
        self._executions = 0

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run one task, with the fault of this execution if it has one."""
        fault = self.faults.get(self._executions)
        self._executions += 1
        time.sleep(self.delay)
        if fault == "raise":
            raise RuntimeError("the motor cut out")
        whole = self.system.execute(controller, task)
        if fault == "nan":
            return Trajectory(whole.times, whole.states * np.nan, whole.inputs)
        if fault == "short":
            return Trajectory(whole.times[:-1], whole.states[:-1], whole.inputs[:-1], ended="stopped by the operator")
        if fault == "wrong shape":
            return Trajectory(whole.times, whole.states[:, :1], whole.inputs)
        return whole
