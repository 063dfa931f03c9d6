"""A task before the execution of S (plan) and after it (outcome, measurement)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller, started
from ctxval.core.space import Parameters
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory, require_times
from ctxval.errors import InputError, ShapeError


@dataclass(frozen=True, eq=False)
class Plan(ShortRepr):
    """What is known of a task g_p, or a batch, before S is executed: its controller and the closed loop on M."""

    parameters: Parameters
    task: Task
    controller: Controller
    model_trajectory: Trajectory

    def of(self, index: int, parameters: Parameters) -> Plan:
        """Return the plan of one task of a batch, whose parameters are given."""
        controller: Any = self.controller
        return Plan(parameters, self.task[index], controller[index], self.model_trajectory[index])


@dataclass(frozen=True, eq=False)
class Outcome(ShortRepr):
    """A plan after the execution of S."""

    plan: Plan
    system_trajectory: Trajectory
    distance: float


@dataclass(frozen=True)
class Measurement:
    """The distance of an execution, or the reason why there is none: the distance function gave no usable number."""

    distance: float | None
    unusable: str | None = None


def require_execution(plan: Plan, trajectory: Trajectory, start_tolerance: float) -> None:
    """Check that a complete trajectory belongs to the task of a plan; see :class:`Validation` for the tolerance."""
    expected = plan.model_trajectory
    require_times(trajectory, plan.task.times)
    if trajectory.states.shape != expected.states.shape or trajectory.inputs.shape != expected.inputs.shape:
        wanted = f"states {expected.states.shape} and inputs {expected.inputs.shape}"
        raise ShapeError(
            f"the trajectory must have {wanted}, got {trajectory.states.shape} and {trajectory.inputs.shape}."
        )
    start = expected.states[0]  # the initial state of the task, or its outputs
    ranges = np.ptp(expected.states, axis=0)
    scale = np.maximum(np.maximum(ranges, np.abs(start)), max(0.05 * ranges.max(), 1e-6))
    near = np.abs(trajectory.states[0] - start) <= start_tolerance * scale
    if not near.all():
        i = int(np.argmin(near))
        wanted = f"{start[i]:g} within {start_tolerance * scale[i]:.3g}, got {trajectory.states[0, i]:g}"
        raise InputError(
            f"the trajectory starts elsewhere: state {i} must start at {wanted}. Check that it belongs to this trial."
        )


def gives_inputs(plan: Plan, trajectory: Trajectory, tolerance: float) -> bool:
    """Return whether the controller of a plan gives the recorded inputs at the recorded states.

    The execution is then also one of this controller: a deterministic system cannot tell the two apart. A controller
    with memory runs along the recorded states from the first one. The tolerance is a share of the largest magnitude of
    each input.
    """
    states, inputs = trajectory.states, trajectory.inputs
    if plan.model_trajectory.states.shape != states.shape or plan.model_trajectory.inputs.shape != inputs.shape:
        return False
    nearest = tolerance * np.maximum(np.abs(inputs).max(axis=0, initial=0.0), 1e-300)
    try:
        with np.errstate(all="ignore"):
            pi = started(plan.controller, plan.task)
            return all(
                bool((np.abs(np.asarray(pi(t, states[t])) - inputs[t]) <= nearest).all()) for t in range(len(inputs))
            )
    except Exception:  # the user's controller, at states that it never reached by itself
        return False
