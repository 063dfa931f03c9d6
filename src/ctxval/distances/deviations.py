"""Distances between the states of M and S, or of S and its task: at the end, over time, or at stated times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import Norm
from ctxval._util.registry import part
from ctxval.core.components import selected
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.base import ErrorNorm, StateNorm, require_numbers
from ctxval.errors import InputError


@part()
@dataclass(frozen=True)
class FinalState(ErrorNorm):
    """Norm of the difference between the final states (the paper's eq. 4, with ``norm=1``).

    :class:`StateNorm` has the attributes.
    """

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        return self.difference(system_trajectory.final_state, model_trajectory.final_state)


@part()
@dataclass(frozen=True)
class AtTimes(ErrorNorm):
    """Largest norm of the difference between the states at stated times, such as those of a grasp or a hand-over.

    Attributes:
        norm, components, weights, scales, angles: as in :class:`StateNorm`.
        times: seconds after the start of the task; each is rounded to the nearest step.
    """

    norm: Norm = 2
    times: Sequence[float] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        require_numbers("times", self.times, None, zero=True)

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        steps = np.round(np.asarray(self.times, dtype=np.float64) / task.dt).astype(np.intp)
        if (steps > task.horizon).any():
            end = task.horizon * task.dt
            raise InputError(f"times must not be after the end of the task at {end:g} s, got {max(self.times):g} s.")
        gap = self.difference(system_trajectory.states[..., steps, :], model_trajectory.states[..., steps, :])
        return np.asarray(gap.reshape(*gap.shape[:-2], -1))

    def compose(self, error: Array) -> Array:
        gap = error.reshape(*error.shape[:-1], len(self.times), -1)
        return np.asarray(np.linalg.norm(gap, self.norm, axis=-1).max(axis=-1))


@part()
@dataclass(frozen=True)
class MaximumDeviation(StateNorm):
    """Maximum over the times 0..H of the norm of the difference between the states, such as the largest gap in metres.

    :class:`StateNorm` has the attributes; the norm is that over the states at one time.
    """

    norm: Norm = 2

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        gap = self.difference(system_trajectory.states, model_trajectory.states)
        return np.asarray(np.linalg.norm(gap, self.norm, axis=-1).max(axis=-1))


@part()
@dataclass(frozen=True)
class MeanDeviation(StateNorm):
    """Mean over the times 1..H of the norm of the difference between the states, such as an average in metres.

    :class:`StateNorm` has the attributes; the norm is that over the states at one time.
    """

    norm: Norm = 2

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        gap = self.difference(system_trajectory.states, model_trajectory.states)
        return np.asarray(np.linalg.norm(gap[..., 1:, :], self.norm, axis=-1).mean(axis=-1))


@part()
@dataclass(frozen=True)
class RelativeDeviation(StateNorm):
    """Maximum over time of the norm of relative errors: the gap of each state, divided by its range on the model.

    The range is that of the state in the trajectory of M for the same task. The distance has no unit: 0.1 means that S
    is away from M by a tenth of the model's own motion.

    Attributes:
        norm, components, weights, scales, angles: as in :class:`StateNorm`.
        least: smallest range that a gap is divided by, for each compared state in its unit; a state at rest would
            otherwise have an unbounded relative error.
    """

    norm: Norm = np.inf
    least: Sequence[float] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        require_numbers("least", self.least, self.components, zero=False)

    def mixed_units(self, units: Sequence[str]) -> tuple[str, ...]:
        return ()

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        gap = self.difference(system_trajectory.states, model_trajectory.states)
        moved = selected(np.ptp(model_trajectory.states, axis=-2), self.components)
        ranges = np.maximum(moved, np.asarray(self.least, dtype=np.float64))
        return np.asarray(np.linalg.norm(gap / ranges[..., None, :], self.norm, axis=-1).max(axis=-1))


@part()
@dataclass(frozen=True)
class WholeTrajectory(StateNorm):
    """Norm of the difference between whole trajectories, taken as one long vector.

    With ``norm=inf`` it is the distance of the paper's OLDT and CCDT. With ``norm=2, per_step=True`` it is the formula
    printed for the Dubins car, ``1/H ||xi_S - xi_M||_2``.

    Attributes:
        norm, components, weights, scales, angles: as in :class:`StateNorm`.
        per_step: whether the norm is divided by the horizon H.
    """

    norm: Norm = np.inf
    per_step: bool = False

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        gap = self.difference(system_trajectory.states, model_trajectory.states)
        whole = np.asarray(np.linalg.norm(gap.reshape(*gap.shape[:-2], -1), self.norm, axis=-1))
        return whole / task.horizon if self.per_step else whole


@part()
@dataclass(frozen=True)
class GoalError(ErrorNorm):
    """Norm of the difference between the system's final state and the goal: both aspects of Remark 1 in one distance.

    With ``norm=1`` it is the formula of the paper's Remark 1, ``||xi_S(H; x_init, pi_p) - p||_1``. :class:`StateNorm`
    has the attributes.
    """

    to_task: ClassVar[bool] = True
    """Whether it measures the system against the task, so that it need not be 0 if the system is like the model."""

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        return self.difference(system_trajectory.final_state, task.goal)


@part()
@dataclass(frozen=True)
class TrackingError(StateNorm):
    """Norm of the difference between S and the reference that it follows, the maximum or the mean over the times 1..H.

    It is the combined measure of Remark 1 for tasks with a reference: :class:`GoalError` is that for tasks with a goal.

    Attributes:
        norm, components, weights, scales, angles: as in :class:`StateNorm`.
        over: ``maximum`` or ``mean``: how the norms at the times are combined.
    """

    to_task: ClassVar[bool] = True

    norm: Norm = 2
    over: Literal["maximum", "mean"] = "maximum"

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        gap = self.difference(system_trajectory.states, task.reference)[..., 1:, :]
        norms = np.linalg.norm(gap, self.norm, axis=-1)
        return np.asarray(norms.max(axis=-1) if self.over == "maximum" else norms.mean(axis=-1))
