"""What is checked and stated before an execution is spent, and how far an execution started from its task."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakSet

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, vector_norm
from ctxval.core.plan import Plan
from ctxval.core.space import Parameters
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError

if TYPE_CHECKING:
    from ctxval.core.validation import Validation

LONGEST = 1_000_000  # default of the largest horizon that is planned

_LONG = 100_000  # horizon from which on the cost of a plan is stated before the first one
_stated: WeakSet[Validation] = WeakSet()


class DistanceWarning(UserWarning):
    """The distance between a trajectory and itself is not 0."""


class CostWarning(UserWarning):
    """A plan needs much time and memory."""


def try_distance(validation: Validation, plan: Plan) -> None:
    """Measure the model's trajectory of a plan against itself; warn if the distance is not 0.

    A distance to the task has the attribute ``to_task = True``.
    """
    value = validation.measure(plan, plan.model_trajectory.copy())
    if value > 1e-9 and not (validation.is_on_model or getattr(validation.distance, "to_task", False)):
        warnings.warn(
            f"the distance between the trajectory of the model and itself is {value:.3g}, not 0, for the task "
            f"{validation.space.describe_point(plan.parameters.points)}. If it measures how S completes its task, give "
            "it the attribute to_task = True; otherwise correct it.",
            DistanceWarning,
            stacklevel=2,
        )


def require_affordable(validation: Validation, parameters: Parameters, task: Task) -> None:
    """Refuse a horizon that is too long; state the cost of a long one once, from the first steps of a plan."""
    steps, permitted = task.horizon, task.horizon <= validation.longest
    if permitted and (steps <= _LONG or validation in _stated):
        return
    probed = min(100, steps)
    first = Task(task.initial_state, horizon=probed, dt=task.dt, reference=task.reference[..., : probed + 1, :])
    begun = time.process_time()
    plan = validation.plan_of(parameters, first)
    seconds = (time.process_time() - begun) * steps / probed
    n, m = plan.model_trajectory.states.shape[-1], plan.model_trajectory.inputs.shape[-1]
    # Two trajectories, and the gains of affine feedback.
    size = 8e-9 * np.prod(task.batch_shape) * steps * (2 * (n + m) + n * m + m)
    cost = f"each plan with a horizon of {steps} needs about {size:.2g} GB of memory and {seconds:.2g} s of CPU time"
    if not permitted:
        raise InputError(
            f"{cost}, and at most {validation.longest} steps are permitted: longest = {steps} permits them, in "
            "Validation or in the experiment file."
        )
    _stated.add(validation)
    warnings.warn(f"{cost}, and a simulated execution about as much.", CostWarning, stacklevel=2)


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
    start: Array = validation.task(validation.space.parameters(point)).initial_state
    gap = np.abs(trajectory.states[0] - start)
    size, state = float(gap.max()), int(gap.argmax())
    if hasattr(validation.distance, "difference"):
        compared = validation.distance.difference(trajectory.states[0], start)
        size = float(vector_norm(compared, getattr(validation.distance, "norm", 1)))
    name, unit = list(validation.names(len(gap), trajectory.inputs.shape[-1])[0].items())[state]
    return StartOffset(size, f"{gap[state]:.2g} {unit}".rstrip() + f" in {name}")
