"""What is checked before an execution is spent, and how far an execution started from its task."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import ArrayLike
from ctxval.core.plan import Plan
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation


class DistanceWarning(UserWarning):
    """The distance between a trajectory and itself is not 0."""


def try_distance(validation: Validation, plan: Plan) -> None:
    """Measure the model's trajectory of a plan against itself; warn if the distance is not 0.

    A distance to the task has the attribute ``to_task = True``.
    """
    value = validation.measure(plan, plan.model_trajectory.copy())
    if value > 1e-9 and not (validation.is_on_model or getattr(validation.distance, "to_task", False)):
        where = validation.space.describe_point(plan.parameters.points)
        warnings.warn(
            f"the distance between the trajectory of the model and itself is {value:.3g}, not 0, for the task {where}. "
            "If it measures how S completes its task, give it the attribute to_task = True; otherwise correct it.",
            DistanceWarning,
            stacklevel=2,
        )


@dataclass(frozen=True)
class StartOffset:
    """How far an execution starts from the initial state of its task.

    The size is as the distance measures differences of states, or the largest of all states if that is unknown. The
    text names the state whose offset is largest.
    """

    size: float
    text: str


def start_offset(validation: Validation, point: ArrayLike, trajectory: Trajectory) -> StartOffset:
    """Return how far an execution of the task at ``(d,)`` starts from the initial state of the task."""
    start = validation.recorded(validation.task(validation.space.parameters(point)).initial_state)
    gap = np.abs(trajectory.states[0] - start)
    size, state = float(gap.max()), int(gap.argmax())
    if hasattr(validation.distance, "difference"):
        compared = validation.distance.difference(trajectory.states[0], start)
        size = float(np.linalg.norm(compared, getattr(validation.distance, "norm", 1), axis=-1))
    name, unit = list(validation.names(len(gap), trajectory.inputs.shape[-1])[0].items())[state]
    return StartOffset(size, f"{gap[state]:.2g} {unit}".rstrip() + f" in {name}")
