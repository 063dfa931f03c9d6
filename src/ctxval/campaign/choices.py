"""What is executed next, and what its execution gave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import call
from ctxval._util.texts import text_of
from ctxval.core.plan import Plan, ended_early, least_distance, recorded_before_failure, recorded_until_end
from ctxval.core.trajectory import COMPLETE, Trajectory
from ctxval.core.trial import Origin, State, Trial
from ctxval.core.trial_note import NO_NOTE, LoopTimes, TrialNote
from ctxval.core.validation import Validation
from ctxval.errors import DistanceError, InputError


@dataclass(frozen=True, eq=False)
class Choice:
    """The task of a new trial."""

    unit_point: Array | None = None  #: point of the unit cube, shape ``(d,)``; None if the search chooses it
    origin: Origin = "acquisition"  #: the reason for this point; not used if the search chooses the point
    because: str | None = None  #: the change that was made to the system since the task was executed before
    #: the planned number of independent draws, which is stored with each draw; 0 if the results decide the number, None
    #: if it is not known
    planned_draws: int | None = None
    note: TrialNote = NO_NOTE  #: what is recorded about the choice
    #: the number of tasks that were tested and are not steady; None if this task is to be tested
    rejected: int | None = None
    #: the task parameters as a person gave them; None if they are those of the point, rounded
    parameters: Mapping[str, Any] | None = None

    @classmethod
    def tested(cls, unit_point: Array, origin: Origin = "covering") -> Choice:
        """Return the choice of a task that needs no test whether it is steady, for a number that results decide."""
        return cls(unit_point, origin, planned_draws=0, rejected=0)


@dataclass(frozen=True, eq=False)
class OpenTrial:
    """A trial to be executed, with everything that an operator needs for the execution."""

    trial: Trial  #: the stored trial
    plan: Plan  #: its task, its controller and the trajectory of the model

    @property
    def number(self) -> int:
        """The number of the trial."""
        return self.trial.number

    def __repr__(self) -> str:
        return call(self, self.number, origin=self.trial.origin, plan=self.plan)


@dataclass(frozen=True, eq=False)
class Execution:
    """What an execution of S gave."""

    #: the object that the system returned or a person recorded, of a failed execution the steps before the failure;
    #: None if there is none
    trajectory: Trajectory | None = None
    distance: float | None = None  #: d(p); None if it is not known
    failed: str | None = None  #: the reason why there is no result: the system failed, or the execution took too long
    at_least: float | None = None  #: what the distance of a failed execution is at least; None if nothing is known
    unusable: str | None = None  #: the reason why the distance function gave no usable number
    #: the seconds after which the closed loops of M and S ended by a fall or an instability, None for one that did not
    ends: LoopTimes | None = None
    #: the seconds after which the robots of M and S fell, None for one that did not; None if neither is known to
    falls: LoopTimes | None = None
    lost: str | None = None  #: the reason why the worker was lost, which is not a failure of the system
    seconds: float | None = None  #: the duration, if it is known

    @classmethod
    def reported(cls, trajectory: Trajectory | None, distance: float | None, failed: str | None) -> Execution:
        """Return an execution as a user reports it: by one of the three; a failure may have a recording, too."""
        if (distance is None) == (trajectory is None and failed is None):
            raise InputError("a trajectory, a distance or the reason of a failure must be given.")
        if distance is not None and not 0 <= distance < np.inf:
            raise InputError(f"the distance must be a finite number >= 0, got {distance!r}.")
        return cls(trajectory, None if distance is None else float(distance) + 0.0, failed)  # -0.0 is 0.0

    @classmethod
    def before_failure(
        cls, validation: Validation, plan: Plan, trajectory: object, failed: str, start_tolerance: float | None = None
    ) -> Execution:
        """Return a failed execution with its steps before, one at least, and what their distance is at least."""
        tolerance = validation.start_tolerance if start_tolerance is None else start_tolerance
        recorded = recorded_before_failure(plan, trajectory, tolerance)
        least = least_distance(validation, plan.parameters.points, plan.model_trajectory, recorded)
        return cls(replace(recorded, ended=text_of(failed)), failed=failed, at_least=least)

    def measured(self, validation: Validation, plan: Plan, start_tolerance: float | None = None) -> Execution:
        """Return the execution with its distance (:meth:`Validation.accept`), or the steps before its failure."""
        if self.failed is not None and self.trajectory is not None:
            try:
                ended = self.before_failure(validation, plan, self.trajectory, self.failed, start_tolerance)
            except InputError as error:
                raise InputError(f"the recording of the failed execution has no step of this task: {error}") from error
            return replace(ended, seconds=self.seconds)
        if self.failed is not None or self.distance is not None:
            return self
        run, of_model = self.trajectory, plan.model_trajectory
        known = self
        if isinstance(run, Trajectory) and not run.batch_shape and validation.fall is not None:
            falls = LoopTimes(validation.fall.seconds(of_model), validation.fall.seconds(run))
            known = replace(self, falls=None if falls == (None, None) else falls)
        if isinstance(run, Trajectory) and ended_early(plan, run):
            tolerance = validation.start_tolerance if start_tolerance is None else start_tolerance
            run = recorded_until_end(plan, run, tolerance)
            alone = of_model.ended == COMPLETE and not validation.falls(run)
            end, end_of_model = (float(part.times[-1] - part.times[0]) for part in (run, of_model))
            ended = replace(known, trajectory=run if run.horizon else None)
            if alone or of_model.ended != COMPLETE:
                ended = replace(ended, ends=LoopTimes(None if alone else end_of_model, end))
            if alone:
                return replace(ended, failed=run.ended)
            return ended._with_distance(lambda: validation.measure(plan, run))
        return known._with_distance(lambda: validation.accept(plan, run, start_tolerance))

    def _with_distance(self, measured: Callable[[], float]) -> Execution:
        try:
            return replace(self, distance=measured())
        except DistanceError as error:
            return replace(self, unusable=text_of(error))

    def ended(self, trial: Trial, *, executed: bool = True) -> Trial:
        """Return a trial in the final state that this measured execution gives it."""
        state: State = "failed" if self.failed is not None else "unmeasured" if self.distance is None else "completed"
        note = replace(trial.note, at_least=self.at_least, ends=self.ends, falls=self.falls)
        failure = self.unusable if self.failed is None else text_of(self.failed)
        ended = replace(trial, state=state, executed=executed, distance=self.distance, failure=failure)
        return replace(ended, seconds=self.seconds, note=note)

    def is_that_of(self, trial: Trial) -> bool:
        """Return whether a trial of the same task has stored this execution already."""
        if trial.distance is None or self.distance is None:
            same = trial.distance is self.distance
        else:
            # A distance that another type of processor has computed differs in its last digits.
            same = bool(np.isclose(trial.distance, self.distance, rtol=1e-9, atol=0))
        return same and trial.failure == self.ended(trial).failure and trial.state != "open"
