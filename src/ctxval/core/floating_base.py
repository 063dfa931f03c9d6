"""Robots with a floating base: its pose and velocity in states of MuJoCo, its fall, and distances until it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval._util.checked import NonNegativeInt, PositiveFloat, checked
from ctxval._util.quaternions import normalised
from ctxval._util.representation import ShortRepr
from ctxval.core.distance import Distance
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError


@checked
@dataclass(frozen=True)
class FloatingBase(ShortRepr):
    """Where states ``(qpos, qvel)`` have the base of a robot.

    A ``free`` joint has seven positions, the place in metres and the unit quaternion w, x, y, z, and six velocities:
    that of the place in the world, and the angular velocity in the body frame. A ``planar`` base has three joints, as
    the robots of gymnasium: x, z and pitch.
    """

    kind: Literal["free", "planar"] = "free"
    position: NonNegativeInt = 0  #: index of the first position of the base
    #: index of its first velocity; None if the states are positions and velocities alone, and the base is the first
    velocity: NonNegativeInt | None = None

    def height(self, x: Array) -> Array:
        """Return the height ``(...)`` of the base in states ``(..., n)``, metres."""
        return np.asarray(x[..., self.position + (2 if self.kind == "free" else 1)])

    def tilt(self, x: Array) -> Array:
        """Return the angle ``(...)`` between the vertical axes of the base and of the world, radians."""
        if self.kind == "planar":
            return np.abs(x[..., self.position + 2])
        return np.arccos(np.clip(-self.gravity(x)[..., 2], -1.0, 1.0))

    def quaternion(self, x: Array) -> Array:
        """Return the unit quaternions ``(..., 4)`` of the base, w first."""
        return normalised(self._of_free(x)[..., self.position + 3 : self.position + 7])

    def gravity(self, x: Array) -> Array:
        """Return the unit vector ``(..., 3)`` of gravity in the body frame."""
        return in_body(self.quaternion(x), np.broadcast_to([0.0, 0.0, -1.0], (*x.shape[:-1], 3)))

    def angular_velocity(self, x: Array) -> Array:
        """Return the angular velocity ``(..., 3)`` in the body frame, rad/s."""
        at = self.first_velocity(x) + 3
        return np.asarray(self._of_free(x)[..., at : at + 3])

    def linear_velocity(self, x: Array, at: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
        """Return the velocity ``(..., 3)`` of a point of the base in the body frame, m/s."""
        first = self.first_velocity(x)
        velocity = in_body(self.quaternion(x), x[..., first : first + 3])
        return velocity + _cross(self.angular_velocity(x), np.asarray(at, dtype=np.float64)) if any(at) else velocity

    def first_velocity(self, x: Array) -> int:
        """Return the index of the first velocity in states ``(..., n)``.

        Raises:
            ShapeError: if n does not fit the base.
        """
        n = int(x.shape[-1])
        if self.velocity is not None:
            return self.velocity
        if n % 2 != (self.kind == "free"):
            raise ShapeError(f"states with a {self.kind} base need {self.kind} joints alone, or `velocity`, got {n}.")
        return (n + 1) // 2

    def at_rest(self, x: Array) -> Array:
        """Return states ``(..., n)`` with all velocities 0."""
        first, still = self.first_velocity(x), np.array(x)
        still[..., first : 2 * first - (self.kind == "free")] = 0.0
        return still

    def _of_free(self, x: Array) -> Array:
        if self.kind != "free":
            raise InputError("only a free base has an orientation and a velocity in the body frame, got a planar base.")
        return x


def in_body(q: Array, v: Array) -> Array:
    """Return vectors ``(..., 3)`` of the world in the frame of unit quaternions ``(..., 4)``, w first."""
    back = -q[..., 1:]
    twice = 2 * _cross(back, v)
    return np.asarray(v + q[..., :1] * twice + _cross(back, twice))


def _cross(a: Array, b: Array) -> Array:
    # Five times as fast as np.cross for one vector, of which a policy needs several in each step.
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


@checked
@dataclass(frozen=True)
class Fall(ShortRepr):
    """The condition of a fall: the base is too low or too much tilted.

    Raises:
        InputError: if neither height nor tilt is given.
    """

    height: float | None = None  #: the least height of the base, metres; None if it does not matter
    tilt: PositiveFloat | None = None  #: the largest angle between the vertical axes of base and world, radians
    base: FloatingBase = field(default_factory=FloatingBase)

    def __post_init__(self) -> None:
        if self.height is None and self.tilt is None:
            raise InputError("a fall needs a least height of the base or a largest tilt.")

    def __call__(self, x: Array) -> Mask:
        """Return whether states ``(..., n)`` are those of a robot that fell, shape ``(...)``."""
        fallen = np.zeros(x.shape[:-1], dtype=bool)
        with np.errstate(invalid="ignore"):
            if self.height is not None:
                fallen |= self.base.height(x) < self.height
            if self.tilt is not None:
                fallen |= self.base.tilt(x) > self.tilt
        return fallen

    def steps(self, trajectory: Trajectory) -> Rows:
        """Return the first step ``(...)`` at which a robot has fallen; H + 1 if it did not."""
        fallen = self(trajectory.states)
        return np.where(fallen.any(axis=-1), fallen.argmax(axis=-1), trajectory.horizon + 1)

    def seconds(self, trajectory: Trajectory) -> float | None:
        """Return the time at which the robot of one trajectory has fallen; None if it did not."""
        step = int(self.steps(trajectory))
        return None if step > trajectory.horizon else float(trajectory.times[step] - trajectory.times[0])

    def lying(self, trajectory: Trajectory, times: Array) -> Trajectory:
        """Return a trajectory in which a robot lies still from its fall on, to the last of the times ``(H + 1,)``."""
        steps = self.steps(trajectory)
        if (steps > trajectory.horizon).all():
            return trajectory
        held = trajectory.held(np.minimum(steps, trajectory.horizon), times)
        lies = np.arange(len(times)) >= np.where(steps > trajectory.horizon, len(times), steps)[..., None]
        return replace(held, states=np.where(lies[..., None], self.base.at_rest(held.states), held.states))


@dataclass(frozen=True)
class UntilFall(ShortRepr):
    """A distance in which a robot lies still from its fall on, so that it is finite if one of M and S falls.

    A validation makes it of its distance if the synthesizer has an attribute ``fall``.
    """

    distance: Distance
    fall: Fall

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance of trajectories, shape ``(...)`` over the batch."""
        return self.distance(*self._lying(model_trajectory, system_trajectory, task), task)

    def with_states(self, names: Sequence[str]) -> UntilFall:
        """Return the same with the indices of states in place of their names."""
        named = getattr(self.distance, "with_states", None)
        return replace(self, distance=named(names)) if callable(named) else self

    def with_quaternions(self, quaternions: Sequence[int]) -> UntilFall:
        """Return the same with the quaternions of a model; see :class:`ctxval.distances.StateNorm`."""
        turning = getattr(self.distance, "with_quaternions", None)
        return replace(self, distance=turning(quaternions)) if callable(turning) else self

    def describe(self) -> dict[str, Any]:
        """Return what identifies this distance in a store."""
        return {"distance": self.distance, "fall": self.fall}

    def _lying(self, model: Trajectory, system: Trajectory, task: Task) -> tuple[Trajectory, Trajectory]:
        return self.fall.lying(model, task.times), self.fall.lying(system, task.times)

    def __getattr__(self, name: str) -> Any:
        # The options of the distance are read by reports and searches; its error vector is that until the fall.
        if name.startswith("_") or name in ("distance", "fall"):
            raise AttributeError(name)
        of_distance: Any = getattr(self.distance, name)
        if name == "error":
            return lambda model, system, task: of_distance(*self._lying(model, system, task), task)
        return of_distance


def until_fall(distance: Distance, synthesizer: object) -> Distance:
    """Return a distance until the fall that the controllers of a synthesizer know, if they know one."""
    fall = getattr(synthesizer, "fall", None)
    return distance if fall is None or isinstance(distance, UntilFall) else UntilFall(distance, fall)
