"""What people say of executions: how one ended, and executions that were made before the campaign."""

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
    """An execution that was made before, checked and measured.

    Attributes:
        unit_point: of its task, in the unit cube, shape ``(d,)``.
        plan: of its task.
        trajectory: what happened; None if the distance or a failure alone is known.
        measurement: its distance, or why there is none; None if it failed.
        failed: why it failed; None if it did not.
    """

    unit_point: Array
    plan: Plan
    trajectory: Trajectory | None
    measurement: Measurement | None
    failed: str | None

    @property
    def distance(self) -> float | None:
        """Its distance, None if there is none."""
        return None if self.measurement is None else self.measurement.distance

    @property
    def failure(self) -> str | None:
        """Why there is no distance, as a trial says it."""
        if self.failed is not None:
            return text_of(self.failed)
        return None if self.measurement is None else self.measurement.unusable


@dataclass(frozen=True, eq=False)
class TrialResult:
    """What is told of an execution: exactly one of three things.

    Attributes:
        trajectory: what happened.
        distance: d(p), if nothing was recorded.
        failed: why there is no result.

    Raises:
        InputError: not exactly one of them is given.
    """

    trajectory: Trajectory | None = None
    distance: float | None = None
    failed: str | None = None

    def __post_init__(self) -> None:
        if sum(given is not None for given in (self.trajectory, self.distance, self.failed)) != 1:
            raise InputError("tell needs one of a trajectory, a distance and the reason of a failure.")


def check_known(
    validation: Validation, point: Array, result: TrialResult, start_tolerance: float | None = None
) -> KnownExecution:
    """Check and measure an execution that was made before; nothing is stored.

    Args:
        validation: the map p -> d(p).
        point: parameters of its task, shape ``(d,)``.
        result: how it ended.
        start_tolerance: in place of the validation's own.

    Raises:
        ExecutionError, InputError: the result is not one of this task.
        ModelError, DesignError: the task cannot be planned.
    """
    unit_point = validation.space.to_unit(point)
    plan = validation.plan(validation.space.from_unit(unit_point))
    measurement = None
    if result.trajectory is not None:
        measurement = validation.accept(plan, result.trajectory, start_tolerance)
    elif result.distance is not None:
        measurement = told_distance(result.distance)
    return KnownExecution(unit_point, plan, result.trajectory, measurement, result.failed)


def told_distance(distance: float) -> Measurement:
    """Return a distance that was told without a trajectory.

    Raises:
        InputError: it is no finite number >= 0.
    """
    valid = isinstance(distance, int | float | np.number) and not isinstance(distance, bool)
    if not valid or not (np.isfinite(distance) and distance >= 0):
        raise InputError(f"the distance must be a finite number >= 0, got {distance!r}.")
    return Measurement(float(distance))


def is_execution_of(trial: Trial, known: KnownExecution) -> bool:
    """Return whether a stored trial is this very execution."""
    if trial.distance is None or known.distance is None:
        same = trial.distance is known.distance
    else:
        # A distance that another processor has computed differs in its last digits.
        same = bool(np.isclose(trial.distance, known.distance, rtol=1e-9, atol=0))
    ended = same and trial.failure == known.failure and trial.state != "open"
    return ended and np.array_equal(trial.unit_point, known.unit_point)
