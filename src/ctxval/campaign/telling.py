"""What a person reports of a trial: a recording (read here or in a confined process), a distance or a failure."""

from __future__ import annotations

import os
import pickle
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import sentinels
from ctxval._util.cores import MOST_MEMORY
from ctxval._util.files import temporary_folder
from ctxval.core.experiment import Experiment
from ctxval.core.labels import labels_of
from ctxval.core.plan import Plan
from ctxval.core.trajectory import COMPLETE, Trajectory
from ctxval.data import LogMapping, is_log, read_recordings
from ctxval.data.rates import Clocked, Column, require_scale
from ctxval.errors import ExecutionError, InputError
from ctxval.systems.subprocess import run_supervised

_PROGRAM = Path(__file__).absolute().with_name("recording_process.py")

REFUSED = 3  #: exit status of the confined process if the file cannot be used; its output is the reason
Names = Mapping[str, str]  #: the names of states or inputs with their units


@dataclass(frozen=True)
class SuppliedResult:
    """The result of a trial, before it is checked: a recording, a distance, or why it failed."""

    recording: Path | None = None  #: the file of the recorded trajectory: CSV, NPZ or a log of another kind
    distance: float | None = None  #: the distance, if there is no recording
    failed: str | None = None  #: the reason why there is no result; a recording has then the steps before the failure
    npz: bool | None = None  #: whether the recording is an NPZ file; None if the suffix decides
    resample: bool = False  #: interpolate the recording to the times of the task
    start_tolerance: float | None = None  #: replaces the start tolerance of the validation
    #: which fields of a log are states and inputs; None if the file has the names of the experiment
    mapping: LogMapping | None = None
    replace: str | None = None  #: why this result replaces an earlier one of the trial; None if the trial is open
    uploaded: bool = False  #: whether somebody sent the recording, who may not learn what a file contains

    def read(self, experiment: Experiment, plan: Plan) -> Trajectory | None:
        """Return the recording; None if there is none."""
        if self.recording is None:
            return None
        if self.mapping is not None and self.mapping.observer is not None:
            raise InputError(
                "the mapping of recordings names an observer, which is for replay, fit and start: the result of a "
                "trial has the recorded states, or outputs, of the experiment."
            )
        names = experiment.names(plan.model_trajectory.states.shape[-1], plan.model_trajectory.inputs.shape[-1])
        # Where libraries in C read the file, or a stranger may have made it.
        read = self.read_confined if self.uploaded or is_log(self.recording) else self.read_file
        return read(self.recording, *names, plan.task.times)

    def read_file(self, path: Path, states: Names, inputs: Names, times: Array) -> Trajectory:
        """Return the recording in a file, of a task with these times ``(H + 1,)``."""
        if is_log(path) or (self.mapping is not None and self.npz is not True and path.is_file()):
            dt = float(times[1] - times[0])
            recordings = read_recordings([path], self.mapping, states=states, inputs=inputs, dt=dt)
            if len(recordings.runs) > 1 or recordings.breaks:
                why = f"; it was split: {recordings.breaks[0]}" if recordings.breaks else ""
                raise InputError(f"{path} must be one recording without gaps, and has {len(recordings.runs)}{why}.")
            logged = recordings.runs[0].trajectory
            return self._resampled(logged, times)
        require_file(path)
        if path.suffix == ".npz" if self.npz is None else self.npz:
            recording = Trajectory.from_npz(path)
        else:
            recording = Trajectory.from_csv(path, states=labels_of(states), inputs=labels_of(inputs))
            if inputs and not recording.inputs.shape[-1]:
                raise InputError(f"{path} must have the columns of the inputs, {', '.join(inputs)}.")
        if recording.states.ndim != 2:
            raise InputError(f"{path} must be one recording, got a batch of shape {recording.states.shape}.")
        if self.failed is None:
            _require_finite(path, recording, states, inputs)
            _require_scale(path, recording, states, inputs, float(times[1] - times[0]))
        return self._resampled(recording, times)

    def _resampled(self, recording: Trajectory, times: Array) -> Trajectory:
        if not self.resample:
            return recording
        recorded = recording.times[-1] - recording.times[0]
        return recording.resampled(times if self.failed is None else times[times <= max(recorded, times[1])])

    def read_confined(self, path: Path, states: Names, inputs: Names, times: Array) -> Trajectory:
        """Return the recording as a process without rights reads it; see :mod:`ctxval._util.cores`."""
        seconds = 60 if self.uploaded else 3600
        with temporary_folder() as folder:
            (folder / "request").write_bytes(pickle.dumps((self, (path, dict(states), dict(inputs), times), seconds)))
            with (folder / "answer").open("w+b") as answer, open(os.devnull, "wb") as nothing:
                command = [sys.executable, "-P", str(_PROGRAM), str(folder)]
                try:
                    status = run_supervised(command, None, answer, nothing, 2 * seconds)
                except ExecutionError as error:
                    raise InputError(f"{path} cannot be read: {error}.") from error
                answer.seek(0)
                content = answer.read()
        if status == 0:
            return Trajectory.from_npz(content)
        if status != REFUSED:
            raise InputError(f"{path} cannot be read within {seconds} s and {MOST_MEMORY} bytes of memory.")
        sentence = content.decode(errors="replace")
        if self.uploaded:  # the place of the mistake, and what would be right, without anything that is in the file
            place = re.search(r", line \d{1,9}", sentence)
            needed = ", ".join(labels_of({"t": "s", **states, **inputs}))
            sentence = (
                f"{path}{'' if place is None else place[0]}: it is not a recording of this trial. The columns or "
                f"fields {needed} are needed, with a finite number for each time from 0 to {times[-1]:g} s."
            )
        raise InputError(sentence)


def _require_finite(path: Path, recording: Trajectory, states: Names, inputs: Names) -> None:
    """Refuse a complete recording with a number that is missing, infinite or a mark; the message says where."""
    if recording.ended != COMPLETE:
        return  # the reason why it ended is reported instead
    failed = "report it as failed: with --failed, or in that column of a table"
    advice = f"If the execution has no usable recording, {failed}."
    for names, values in ((list(states), recording.states), (list(inputs), recording.inputs)):
        wrong = np.argwhere(~np.isfinite(values[:, : len(names)]))
        if len(wrong):
            row, column = wrong[0]
            where = f"{names[column]} is {values[row, column]} at {recording.times[row]:g} s"
            raise InputError(f"{path} is not finite: {where}. {advice}")
        for name, column in zip(names, values.T, strict=False):
            if marks := sentinels(column):
                at = recording.times[int(np.argmax(column == marks[0]))]
                raise InputError(
                    f"{path}: {name} is {marks[0]:g} at {at:g} s, far from all other values, which stands "
                    f"for a missing one. {advice}"
                )


def _require_scale(path: Path, recording: Trajectory, states: Names, inputs: Names, dt: float) -> None:
    """Refuse a complete recording whose times, units or signs contradict each other, as every log is refused."""
    widths = recording.states.shape[-1], recording.inputs.shape[-1]
    if recording.ended != COMPLETE or recording.horizon < 2 or widths != (len(states), len(inputs)):
        return
    named = [Column(name, unit, of is inputs) for of in (states, inputs) for name, unit in of.items()]
    period = float(np.median(np.diff(recording.times)))
    if np.isclose(period, dt, rtol=0.5):  # else its times are refused
        require_scale(str(path), [recording], named, period, Clocked("t", confirmed=True))


def require_file(path: Path) -> None:
    """Refuse a path that is not a readable file, with a clearer message than that of a reader."""
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    if not is_file:
        raise InputError(f"{path} cannot be read: it is a folder." if is_folder else f"there is no file {path}.")
