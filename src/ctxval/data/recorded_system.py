"""Recordings as a system, and as its tasks and controllers if nothing else is known of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr, call
from ctxval._util.texts import enumerated
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from ctxval.core.plan import input_difference, inputs_along
from ctxval.core.space import Parameters
from ctxval.core.task import Task
from ctxval.core.trajectory import COMPLETE, TERMINATED, Trajectory
from ctxval.data.mapping import LogMapping
from ctxval.data.readers import logs_in
from ctxval.data.recordings import read_recordings
from ctxval.errors import ExecutionError, InputError


class RecordedInputsWarning(UserWarning):
    """Recorded inputs are not those of the controller of their task."""


@dataclass(frozen=True, eq=False)
class RecordedInputs(ShortRepr):
    """Recorded inputs ``(H, m)`` as a controller, such as the commands of an arm whose servos control its joints."""

    inputs: Array

    def __call__(self, t: int, x: Array) -> Array:
        """Return the inputs ``(..., m)`` of a step, whatever the states ``(..., n)`` are."""
        return np.broadcast_to(self.inputs[t], (*x.shape[:-1], self.inputs.shape[-1]))


@part(files=("runs", "mapping"))
class Recorded:
    """Recorded executions of named tasks, such as those of a :class:`ctxval.TaskSuite`, as the true system.

    The execution of a task is the recording with its name; the controller is not asked. So a campaign sees what it
    would have seen on the system, one execution at a time, and can be judged afterwards by what it did not see. The
    recordings must be made with the controllers of the campaign, which holds for controllers that do not depend on M.
    If only their inputs are known, it is the task function (:meth:`task`) and the synthesizer of a validation, too.

    Args:
        runs: the recordings by the names of their tasks, one or several in the order in which a campaign gets them; or
            a folder with one log for each task, whose name is that of the file without its ending, or with a folder of
            this name for several.
        mapping: which fields of the logs are states and inputs, and how long a step is; a TOML file, a table as in
            one, or :class:`ctxval.data.LogMapping`. Without inputs, they are those that the controller gives along
            the records.
        stopped_by: what ended recordings that are shorter than their task, such as "a safety limit". They are then
            outcomes, as a fall is. If it is empty, they are failed executions.

    Raises:
        InputError: if there is no recording, or if one has gaps.
    """

    def __init__(
        self,
        runs: Mapping[str, Trajectory | Sequence[Trajectory]] | str | Path,
        mapping: LogMapping | dict[str, Any] | str | Path | None = None,
        stopped_by: str = "",
    ) -> None:
        self.stopped_by = stopped_by
        self.runs: dict[str, tuple[Trajectory, ...]] = {}
        if isinstance(runs, Mapping):
            for name, given in runs.items():
                self.runs[name] = (given,) if isinstance(given, Trajectory) else tuple(given)
        else:
            chosen = LogMapping.from_table(mapping) if isinstance(mapping, dict) else mapping
            chosen = LogMapping.from_toml(chosen) if isinstance(chosen, str | Path) else chosen
            folders = sorted(each for each in Path(runs).iterdir() if each.is_dir()) if Path(runs).is_dir() else []
            for path in [log for each in folders or [Path(runs)] for log in logs_in(each)]:
                whole = read_recordings([path], chosen).runs
                if len(whole) != 1:
                    raise InputError(f"{path} must have one recording without gaps, and has {len(whole)}.")
                name = path.stem if path.suffix.lower() != ".gz" else Path(path.stem).stem
                name = path.parent.name if folders else name
                self.runs[name] = (*self.runs.get(name, ()), whole[0].trajectory)
        if not self.runs or not all(self.runs.values()):
            raise InputError("there is no recording, or none of a task.")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.runs)

    @property
    def repeats(self) -> int:
        """The number of recordings that each task has at least, for the repeats of a suite."""
        return min(map(len, self.runs.values()))

    def task(self, p: Parameters) -> Task:
        """Return the task that the first recording is of: from its first state, for all its steps."""
        run = self._run(str(p.task))
        return Task(run.states[0], horizon=run.horizon, dt=float(run.times[1] - run.times[0]))

    def design(self, task: Task, model: Model) -> RecordedInputs:
        """Return the recorded inputs of a task, in an open loop, for controllers of which nothing else is known."""
        return RecordedInputs(self._run(task.name).inputs)

    def _run(self, name: str, repetition: int = 0) -> Trajectory:
        if name not in self.runs:
            known = enumerated(self.runs, 6)
            raise ExecutionError(f"there is no recording of the task {name!r}; there are those of {known}")
        runs = self.runs[name]
        if repetition >= len(runs) > 1:
            raise ExecutionError(f"the task {name!r} has {len(runs)} recordings, and all of them were executed")
        return runs[min(repetition, len(runs) - 1)]

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Return the recording of a task that is next in turn; raise an ExecutionError if there is none.

        Raises:
            ExecutionError: if the recording is shorter than the task.
        """
        run, steps = self._run(task.name, task.repetition), task.horizon
        ended = run.ended if run.horizon <= steps else COMPLETE
        if run.horizon < steps and self.stopped_by:
            ended = f"{TERMINATED}: {self.stopped_by}"
        elif run.horizon < steps and not run.is_outcome:
            raise ExecutionError(f"the recording of {task.name!r} has {run.horizon} steps, and the task has {steps}")
        times, states, inputs = run.times[: steps + 1], run.states[: steps + 1], run.inputs[:steps]
        if not inputs.shape[-1]:
            inputs = np.stack(list(inputs_along(controller, task, states[:-1])))
            return Trajectory(times, states, inputs, ended=ended)
        recorded = Trajectory(times, states, inputs, ended=ended)
        names = {f"u{i}": "" for i in range(inputs.shape[-1])}
        if difference := input_difference(controller, task, recorded, names):
            warnings.warn(
                f"the inputs of the recording of {task.name!r} are not those of the controller at the recorded states "
                f"({difference}): check that it was recorded with this controller, and that both begin at once.",
                RecordedInputsWarning,
                stacklevel=2,
            )
        return recorded

    def __repr__(self) -> str:
        return call(self, tasks=len(self.runs), repeats=self.repeats if self.repeats > 1 else None)
