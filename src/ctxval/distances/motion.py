"""Distances between motions of robots with a floating base, whose states are those of MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import FiniteFloat, NonNegativeFloat, NonNegativeInt
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.distance import NamedStates, selected
from ctxval.core.floating_base import Fall, FloatingBase
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import ShapeError

Over = Literal["average", "mean", "maximum"]


@part()
@dataclass(frozen=True)
class BodyVelocity(ShortRepr):
    """Norm of the difference between the velocities of M and S in the body frame, in m/s, and its yaw rate in rad/s.

    The velocity is that in the directions x and y of the body, and the yaw rate is that about its z. Paths of robots
    with contacts differ by themselves after some steps. Their average velocities do not.
    """

    #: ``average``: the difference of the velocities averaged over the task; ``mean`` or ``maximum``: the mean or the
    #: maximum over the times 1..H of the norms
    over: Over = "average"
    yaw: NonNegativeFloat = 0.0  #: weight of the yaw rate, metres
    after: NonNegativeFloat = 0.0  #: seconds at the start that do not count, in which the robot accelerates
    base: FloatingBase = field(default_factory=FloatingBase)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        gap = self.planar(system_trajectory.states) - self.planar(model_trajectory.states)
        return self._over(gap[..., _first(self.after, task) :, :])

    def planar(self, x: Array) -> Array:
        """Return the velocities ``(..., 3)`` along x and y and the weighted yaw rate in states ``(..., n)``."""
        rate = self.base.angular_velocity(x)[..., 2:]
        return np.concatenate([self.base.linear_velocity(x)[..., :2], self.yaw * rate], axis=-1)

    def _over(self, gap: Array) -> Array:
        if self.over == "average":
            return np.asarray(np.linalg.norm(gap.mean(axis=-2), axis=-1))
        norms = np.linalg.norm(gap, axis=-1)
        return np.asarray(norms.mean(axis=-1) if self.over == "mean" else norms.max(axis=-1))


@part()
@dataclass(frozen=True)
class CommandError(BodyVelocity):
    """Norm of the difference between the velocity of S in the body frame and the command (vx, vy, yaw rate).

    It is the combined measure of Remark 1 for policies that follow a command; M alone is measured for Aspect 1.
    :class:`BodyVelocity` has the attributes.

    Raises:
        ShapeError: if the command of a task has not three numbers.
    """

    to_task: ClassVar[bool] = True

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        if task.command.shape[-1] != 3:
            got = task.command.shape[-1]
            raise ShapeError(f"the command must be the velocities along x and y and the yaw rate, got {got} numbers.")
        gap = self.planar(system_trajectory.states) - task.command[..., None, :] * [1.0, 1.0, self.yaw]
        return self._over(gap[..., _first(self.after, task) :, :])


@part()
@dataclass(frozen=True)
class Orientation(ShortRepr):
    """Largest geodesic angle in radians between the orientations of M and S, whose states have unit quaternions.

    The quaternions q and -q are one orientation, so the angle is at most pi.
    """

    monotone: ClassVar[bool] = True

    quaternion: NonNegativeInt = 3  #: index of w, which x, y and z follow; that of a free joint at the first state is 3

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        first, second = (run.states[..., self.quaternion :][..., :4] for run in (model_trajectory, system_trajectory))
        # 2 atan2(|p - q|, |p + q|), halved and doubled, is exact for small angles, of which arccos loses the digits.
        p, q = (x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12) for x in (first, second))
        apart, together = np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1)
        return np.asarray(4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together)).max(axis=-1))


@part()
@dataclass(frozen=True)
class FallTime(ShortRepr):
    """Difference in seconds between the times at which M and S fall; a robot that does not fall counts at the end."""

    height: float | None = None  #: the least height of the base, metres; None if it does not matter
    tilt: float | None = None  #: the largest angle between the vertical axes of base and world, radians
    base: FloatingBase = field(default_factory=FloatingBase)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        fall = Fall(self.height, self.tilt, self.base)
        of_system, of_model = (
            np.minimum(fall.steps(run), task.horizon) for run in (system_trajectory, model_trajectory)
        )
        return np.asarray(np.abs(of_system - of_model) * task.dt)


@part()
@dataclass(frozen=True)
class ContactTime(NamedStates):
    """Largest difference in seconds between the times for which a foot of M and of S touches the ground, by its height.

    The heights of feet are states, as those of sites of :class:`ctxval.systems.MuJoCo` with ``axes="z"``.
    """

    components: Sequence[int | str]  #: the heights of the feet, by index or by the name in the experiment
    height: FiniteFloat  #: a foot touches the ground if it is not higher, metres

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        of_system, of_model = (
            (selected(run.states[..., 1:, :], self.components) <= self.height).sum(axis=-2)
            for run in (system_trajectory, model_trajectory)
        )
        return np.asarray(np.abs(of_system - of_model).max(axis=-1) * task.dt)


def _first(after: float, task: Task) -> int:
    """Return the first step that counts, 1 at least."""
    return min(max(1, round(after / task.dt)), task.horizon)
