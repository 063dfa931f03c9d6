"""Recorded executions in the place of a system: each is revealed when its task is chosen."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr, call
from ctxval._util.texts import enumerated
from ctxval.core.controller import Controller, started
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.data.mapping import LogMapping
from ctxval.data.readers import logs_in, task_of
from ctxval.data.recordings import read_recordings
from ctxval.errors import ExecutionError, InputError


@part(files=("runs",))
class Recorded(ShortRepr):
    """Recorded executions of named tasks, such as those of a :class:`ctxval.TaskSuite`, as the true system.

    The execution of a task is the recording with its name; the controller is not asked. So a campaign sees what it
    would have seen on the system, one execution at a time, and can be judged afterwards by what it did not see. The
    recordings must be made with the controllers of the campaign, which holds for controllers that do not depend on M.

    Args:
        runs: the recordings by the names of their tasks, or a folder with one log for each task, whose name is that of
            the file without its ending.
        mapping: which fields of the logs are states and inputs, and how long a step is; a table as in a file, or
            :class:`ctxval.data.LogMapping`. Without inputs, they are those that the controller gives along the records.
    """

    def __init__(
        self, runs: Mapping[str, Trajectory] | str | Path, mapping: LogMapping | dict[str, Any] | None = None
    ) -> None:
        if isinstance(runs, Mapping):
            self.runs = dict(runs)
        else:
            chosen = LogMapping.from_table(mapping) if isinstance(mapping, dict) else mapping
            self.runs = {task_of(path): _only_run(path, chosen) for path in logs_in(Path(runs))}
        if not self.runs:
            raise InputError("there is no recording.")

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the tasks."""
        return tuple(self.runs)

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Return the recording of a task; raise an ExecutionError if there is none."""
        if task.name not in self.runs:
            known = enumerated(self.runs, 6)
            raise ExecutionError(f"there is no recording of the task {task.name!r}; there are those of {known}")
        run, steps = self.runs[task.name], task.horizon
        if run.horizon < steps:
            raise ExecutionError(f"the recording of {task.name!r} has {run.horizon} steps, and the task has {steps}")
        times, states, inputs = run.times[: steps + 1], run.states[: steps + 1], run.inputs[:steps]
        if not inputs.shape[-1]:
            pi = started(controller, task)
            inputs = np.stack([np.asarray(pi(t, x), dtype=np.float64) for t, x in enumerate(states[:-1])])
        return Trajectory(times, states, inputs)

    def __repr__(self) -> str:
        return call(self, tasks=len(self.runs))


def _only_run(path: Path, mapping: LogMapping | None) -> Trajectory:
    runs = read_recordings([path], mapping).runs
    if len(runs) != 1:
        raise InputError(f"{path} must have one recording without gaps, and has {len(runs)}.")
    return runs[0].trajectory
