"""The candidates of a comparison: campaigns on one system, and what their stores remember of the comparison."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.describe import describe, differences
from ctxval.campaign import Campaign
from ctxval.campaign.history import executed_trials
from ctxval.campaign.trials import TrialRecorder
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import InputError

Question = Literal["worst", "mean"]

NOTE = "comparison"
"""Key in the note of a trial of what the comparison decided before this trial."""


@dataclass(frozen=True, eq=False)
class TrialNote:
    """What a comparison stores with a trial, before its execution.

    Attributes:
        step: the number of the execution among those of all candidates, from 0; a shared execution has one number.
        question: the question that the execution answers.
        draw: the number of the task among the independent draws; None if the task is no draw.
        predicted: the distance that was predicted for a draw before it was drawn; None if nothing was predicted.
        centre: the mean of this prediction over other tasks.
        shared: the name of the candidate that executed the task and the number of its trial; None if this one did.
        decided: what had been decided about the largest distances, in types that JSON has.
    """

    step: int
    question: Question
    draw: int | None = None
    predicted: float | None = None
    centre: float | None = None
    shared: tuple[str, int] | None = None
    decided: tuple[Mapping[str, Any], ...] = ()

    def to_note(self) -> dict[str, Any]:
        """Return the note of the trial."""
        known = {name: value for name, value in vars(self).items() if value not in (None, ())}
        if self.shared is not None:
            known["shared"] = list(self.shared)
        return {NOTE: {**known, "decided": [dict(one) for one in self.decided]}}

    @classmethod
    def of(cls, trial: Trial) -> Self | None:
        """Return what a comparison stored with a trial; None if it stored nothing."""
        note = (trial.note or {}).get(NOTE)
        if not isinstance(note, dict) or not isinstance(note.get("step"), int):
            return None
        shared = note.get("shared")
        return cls(
            note["step"],
            "mean" if note.get("question") == "mean" else "worst",
            note.get("draw"),
            note.get("predicted"),
            note.get("centre"),
            (str(shared[0]), int(shared[1])) if isinstance(shared, list) and len(shared) == 2 else None,
            tuple(note.get("decided") or ()),
        )


@dataclass(frozen=True, eq=False)
class Candidate:
    """One model, controller or distance, with its campaign."""

    name: str
    campaign: Campaign
    _trajectories: dict[int, Trajectory] = field(default_factory=dict, init=False)

    @property
    def recorder(self) -> TrialRecorder:
        """The recorder of the trials."""
        return self.campaign.recorder

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All trials in the order of asking."""
        return self.recorder.trials

    @property
    def largest(self) -> float:
        """The largest executed distance; 0 if there is none."""
        return max((trial.distance for trial in self.trials if trial.distance is not None), default=0.0)

    @property
    def executed(self) -> list[Trial]:
        """The trials with an execution of their own, with or without success."""
        return [trial for trial in self.trials if trial.executed and not is_shared(trial)]

    @property
    def shared(self) -> list[Trial]:
        """The trials whose execution is that of another candidate."""
        return [trial for trial in self.trials if trial.executed and is_shared(trial)]

    def trial_at(self, point: Array) -> Trial | None:
        """Return the last trial of a task, a point of the unit cube ``(d,)``; None if there is none."""
        trials = [trial for trial in self.trials if np.array_equal(trial.unit_point, point)]
        return trials[-1] if trials else None

    def trajectories(self) -> Iterator[tuple[Trial, Trajectory]]:
        """Yield the completed trials with a recorded trajectory; each trajectory is read once."""
        trials = {trial.number: trial for trial in self.trials if trial.state == "completed"}
        unread = [trial for number, trial in trials.items() if number not in self._trajectories]
        if unread:
            self._trajectories.update(
                (one.number, found) for one, found in executed_trials(self.campaign.store, unread)
            )
        for number, trial in trials.items():
            if number in self._trajectories:
                yield trial, self._trajectories[number]


def is_shared(trial: Trial) -> bool:
    """Return whether the execution of a trial is that of another candidate."""
    note = TrialNote.of(trial)
    return note is not None and note.shared is not None


def require_comparable(candidates: Mapping[str, Validation]) -> None:
    """Check that the candidates have the same system, the same tasks and distances of the same unit."""
    if len(candidates) < 2:
        raise InputError(f"a comparison needs at least two candidates, got {len(candidates)}.")
    if any(getattr(candidate.system, "manual", False) for candidate in candidates.values()):
        raise InputError("candidates cannot be compared on a system that people execute.")
    (first, expected), *others = candidates.items()
    described = _comparable(expected)
    for other, validation in others:
        other_described = _comparable(validation)
        for part, what in (("space", "task spaces"), ("tasks", "tasks"), ("system", "systems")):
            unequal = next(differences(described[part], other_described[part], part), None)
            if unequal is not None:
                raise InputError(
                    f"{first} and {other} must have the same {what}, but {unequal[0]} differs: only models, "
                    "controllers and distances on one system can be compared."
                )
        if validation.labels.units != expected.labels.units:
            raise InputError(
                f"the distances of {first} and {other} must have the same unit, got "
                f"{expected.labels.units or 'none'!r} and {validation.labels.units or 'none'!r}."
            )


def _comparable(validation: Validation) -> dict[str, Any]:
    """Return the description of a validation, and three of its tasks."""
    space = validation.space
    probes = (space.low, 0.5 * (space.low + space.high), space.high)
    tasks = [describe(validation.task(space.parameters(point))) for point in probes]
    return {**validation.describe(), "tasks": tasks}
