"""What a person reports of a trial: a recording, a distance or a failure, as a file and plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval._util.representation import record
from ctxval.campaign.by_hand import read_recording
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.choices import OpenTrial
from ctxval.core.experiment import Experiment
from ctxval.core.trial import Trial
from ctxval.data import LogMapping
from ctxval.errors import InputError


@dataclass(frozen=True)
class ToldResult:
    """The result of an open trial, before it is checked. Exactly one of recording, distance and failed is given.

    Attributes:
        recording: the file of the recorded trajectory: CSV, NPZ or a log of another kind.
        distance: the distance, if there is no recording.
        failed: the reason why there is no result.
        npz: whether the recording is an NPZ file; None if the suffix decides.
        resample: interpolate the recording to the times of the task.
        start_tolerance: replaces the start tolerance of the validation.
        mapping: which fields of a log are states and inputs; None if the file has the names of the experiment.
    """

    recording: Path | None = None
    distance: float | None = None
    failed: str | None = None
    npz: bool | None = None
    resample: bool = False
    start_tolerance: float | None = None
    mapping: LogMapping | None = None

    def __repr__(self) -> str:
        return record(self)


def require_tolerance(given: float | None, name: str) -> None:
    """Check a start tolerance.

    Args:
        given: the tolerance; None if there is none.
        name: the name of the option or of the field, for the message.

    Raises:
        InputError: if it is not a finite number >= 0.
    """
    if given is not None and not (0 <= given < math.inf):
        raise InputError(f"{name} must be a finite number >= 0, got {given!r}.")


def tell_result(campaign: Campaign, experiment: Experiment, trial: OpenTrial | int, told: ToldResult) -> Trial:
    """Check and store the result of an open trial.

    Args:
        campaign: the campaign of the trial.
        experiment: gives the names of the columns of a recording.
        trial: the open trial, or its number. A controller is designed only if a number comes with a recording.
        told: the result.

    Raises:
        InputError, ExecutionError, DistanceError: as in :meth:`ctxval.Campaign.tell`, and if the file cannot be read.
    """
    recording = None
    if told.recording is not None:
        trial = trial if isinstance(trial, OpenTrial) else campaign.reopen(trial)
        recording = read_recording(
            *(told.recording, experiment, trial.plan),
            npz=told.npz,
            resample=told.resample,
            mapping=told.mapping,
        )
    return campaign.tell(
        trial, recording, distance=told.distance, failed=told.failed, start_tolerance=told.start_tolerance
    )


def result_sentence(trial: Trial, units: str = "") -> str:
    """Return the result of a trial that has ended, in one sentence without its full stop.

    Args:
        trial: the trial.
        units: the units of the distance.
    """
    if trial.state == "unmeasured":
        return f"trial {trial.number} is stored without a distance: {trial.failure}"
    if trial.distance is None:
        return f"trial {trial.number} failed: {trial.failure}"
    return f"trial {trial.number} has the distance {trial.distance:.4g} {units}".rstrip()


def parameters_of_trial(campaign: Campaign, number: int) -> Mapping[str, Any]:
    """Return the parameters of the task of a trial.

    Raises:
        InputError: if there is no trial of this number.
    """
    known = {trial.number: trial.parameters for trial in campaign.trials}
    if number not in known:
        raise InputError(f"there is no trial {number}; there are {len(known)}, numbered from 0.")
    return known[number]
