"""Checks of results that users supply: of open trials, and of executions before the campaign."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.texts import text_of
from ctxval.core.plan import Measurement, Plan
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class KnownExecution:
    """An earlier execution, checked and measured.

    Attributes:
        unit_point: the point of the task in the unit cube, shape ``(d,)``.
        plan: the plan of the task.
        trajectory: the recorded trajectory; None if only the distance or the failure is known.
        measurement: the distance, or the reason why there is none; None if the execution failed.
        failed: the reason of the failure; None if the execution did not fail.
    """

    unit_point: Array
    plan: Plan
    trajectory: Trajectory | None
    measurement: Measurement | None
    failed: str | None

    @property
    def distance(self) -> float | None:
        """The distance; None if there is none."""
        return None if self.measurement is None else self.measurement.distance

    @property
    def failure(self) -> str | None:
        """The reason why there is no distance, as the trial stores it; None if there is a distance."""
        if self.failed is not None:
            return text_of(self.failed)
        return None if self.measurement is None else self.measurement.unusable


@dataclass(frozen=True, eq=False)
class TrialResult:
    """The result of an execution, as a user supplies it. Exactly one of the three attributes is given.

    Attributes:
        trajectory: the recorded trajectory.
        distance: d(p), if there is no recording.
        failed: the reason why there is no result.
    """

    trajectory: Trajectory | None = None
    distance: float | None = None
    failed: str | None = None

    def __post_init__(self) -> None:
        if sum(given is not None for given in (self.trajectory, self.distance, self.failed)) != 1:
            raise InputError("exactly one of a trajectory, a distance and the reason of a failure must be given.")


def check_known(
    validation: Validation, point: Array, result: TrialResult, start_tolerance: float | None = None
) -> KnownExecution:
    """Check and measure an earlier execution; nothing is stored."""
    unit_point, plan = validation.space.to_unit(point), validation.plan(point)
    measurement = None
    if result.trajectory is not None:
        measurement = validation.accept(plan, result.trajectory, start_tolerance)
    elif result.distance is not None:
        measurement = measurement_of(result.distance)
    return KnownExecution(unit_point, plan, result.trajectory, measurement, result.failed)


def measurement_of(distance: float) -> Measurement:
    """Return the measurement of a distance that is given without a trajectory."""
    valid = isinstance(distance, int | float | np.number) and not isinstance(distance, bool)
    if not valid or not (np.isfinite(distance) and distance >= 0):
        raise InputError(f"the distance must be a finite number >= 0, got {distance!r}.")
    return Measurement(float(distance))


def is_execution_of(trial: Trial, known: KnownExecution) -> bool:
    """Return whether a stored trial and a known execution are the same execution."""
    if trial.distance is None or known.distance is None:
        same = trial.distance is known.distance
    else:
        # A distance that another type of processor has computed differs in its last digits.
        same = bool(np.isclose(trial.distance, known.distance, rtol=1e-9, atol=0))
    ended = same and trial.failure == known.failure and trial.state != "open"
    return ended and np.array_equal(trial.unit_point, known.unit_point)
