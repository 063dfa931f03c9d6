"""What a person reports of a trial: a recording, a distance or a failure, as a file and plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval.campaign.campaign import Campaign
from ctxval.campaign.choices import OpenTrial
from ctxval.campaign.recording_file import RecordingFile
from ctxval.core.experiment import Experiment
from ctxval.core.plan import Plan, StartOffset
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.data import LogMapping, is_log
from ctxval.errors import InputError


@dataclass(frozen=True)
class ToldResult:
    """The result of a trial, before it is checked. Exactly one of recording, distance and failed is given.

    Attributes:
        recording: the file of the recorded trajectory: CSV, NPZ or a log of another kind.
        distance: the distance, if there is no recording.
        failed: the reason why there is no result.
        npz: whether the recording is an NPZ file; None if the suffix decides.
        resample: interpolate the recording to the times of the task.
        start_tolerance: replaces the start tolerance of the validation.
        mapping: which fields of a log are states and inputs; None if the file has the names of the experiment.
        replace: why this result replaces an earlier one of the trial; None if the trial is open.
        uploaded: whether somebody sent the recording, who may not learn what a file contains.
    """

    recording: Path | None = None
    distance: float | None = None
    failed: str | None = None
    npz: bool | None = None
    resample: bool = False
    start_tolerance: float | None = None
    mapping: LogMapping | None = None
    replace: str | None = None
    uploaded: bool = False

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
        times, npz, resample = plan.task.times, self.npz, self.resample
        file = RecordingFile(self.recording, *names, times, npz, resample, self.mapping, self.uploaded)
        # Where libraries in C read the file, or a stranger may have made it.
        return file.read_confined() if self.uploaded or is_log(self.recording) else file.read()


def tell_result(campaign: Campaign, experiment: Experiment, trial: OpenTrial | int, told: ToldResult) -> Trial:
    """Check and store the result of an open trial."""
    recording = None
    if told.recording is not None:
        trial = trial if isinstance(trial, OpenTrial) else campaign.reopen(trial, ended=told.replace is not None)
        recording = told.read(experiment, trial.plan)
    return campaign.tell(
        trial,
        recording,
        distance=told.distance,
        failed=told.failed,
        start_tolerance=told.start_tolerance,
        replace=told.replace,
    )


def result_sentence(trial: Trial, units: str = "", start: StartOffset | None = None) -> str:
    """Return the result of a trial that has ended, in one sentence without its full stop."""
    if trial.state == "unmeasured":
        return f"trial {trial.number} is stored without a distance: {trial.failure}"
    if trial.distance is None:
        return f"trial {trial.number} failed: {trial.failure}"
    sentence = f"trial {trial.number} has the distance {trial.distance:.4g} {units}".rstrip()
    return sentence if start is None or not start.size else f"{sentence}; its start was off by {start.text}"


def parameters_of_trial(campaign: Campaign, number: int) -> Mapping[str, Any]:
    """Return the parameters of the task of a trial."""
    known = {trial.number: trial.parameters for trial in campaign.trials}
    if number not in known:
        raise InputError(f"there is no trial {number}; there are {len(known)}, numbered from 0.")
    return known[number]
