"""Distances between the states of M and S, or of S and its task: at the end, over time, at stated times, at events."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite
from ctxval._util.checked import FiniteFloat, Norm, PositiveInt
from ctxval._util.registry import part
from ctxval.core.distance import NamedStates, require_indices, selected
from ctxval.core.state_geometry import StateGeometry
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError


@dataclass(frozen=True)
class StateNorm(NamedStates):
    """A norm of differences between states.

    Each difference is multiplied by its weight, divided by its scale, and then enters the norm. With a scale in the
    unit of its state, such as 0.1 m and 0.05 rad, differences of one scale count the same.

    Raises:
        InputError: if components are empty.
    """

    norm: Norm = 1  #: order of the norm: 1, 2 or infinity
    #: the states that are compared, by index or by the name in the experiment; all states by default
    components: Sequence[int | str] | None = None
    _: KW_ONLY
    weights: Sequence[float] | None = None  #: one number >= 0 for each compared state; 1 by default
    #: the unit of comparison of each compared state, a positive number; 1 by default
    scales: Sequence[float] | None = None
    #: the states that are angles in radians, by index or name; the difference is taken on the circle, so it is at most
    #: pi
    angles: Sequence[int | str] = ()
    #: the states that are the first number, w, of a unit quaternion, by index or name. Its difference is a rotation
    #: vector in radians in the places of x, y and z, and 0 in that of w. Those of a MuJoCo model are found.
    quaternions: Sequence[int | str] = ()

    def __post_init__(self) -> None:
        if self.components is not None and not len(self.components):
            raise InputError("components must name at least one state; leave it out to compare all states.")
        require_numbers("weights", self.weights, self.components, zero=True)
        require_numbers("scales", self.scales, self.components, zero=False)

    @property
    def factors(self) -> Array | None:
        """The factor of the difference of each compared state, shape ``(k,)``; None if all are 1."""
        weights, scales = (1.0 if given is None else np.asarray(given) for given in (self.weights, self.scales))
        factors = np.asarray(weights / scales, dtype=np.float64)
        return None if (factors == 1).all() else factors

    def difference(self, states: Array, others: Array) -> Array:
        """Return the weighted differences of the compared ones of states ``(..., n)``; leading axes broadcast.

        Raises:
            ShapeError: if there is not a weight or scale for each state.
        """
        gap = selected(self.gap(states, others), self.components)
        counts = [len(given) for given in (self.weights, self.scales) if given is not None]
        if set(counts) - {gap.shape[-1]}:
            raise ShapeError(f"there must be a weight or a scale for each of {gap.shape[-1]} states, got {counts[0]}.")
        factors = self.factors
        return gap if factors is None else gap * factors

    def norms(self, states: Array, others: Array) -> Array:
        """Return the norms of the weighted differences of states ``(..., n)``, shape ``(...)``."""
        return np.asarray(np.linalg.norm(self.difference(states, others), self.norm, axis=-1))

    def gap(self, states: Array, others: Array) -> Array:
        """Return the differences of all states ``(..., n)``; those of angles are at most pi in magnitude."""
        gap = self._geometry(states.shape[-1]).difference(states, others)
        if not len(self.angles):
            return gap
        moved = np.array(gap)
        angles = require_indices("angles", self.angles, gap.shape[-1])
        moved[..., angles] = turned(gap[..., angles])
        return moved

    def _geometry(self, states: int) -> StateGeometry:
        places = require_indices("quaternions", self.quaternions, states - 3) if len(self.quaternions) else []
        return StateGeometry(tuple(places))

    def with_quaternions(self, quaternions: Sequence[int]) -> Self:
        """Return the same with the quaternions of a model, if it names none and compares all of their numbers."""
        if len(self.quaternions) or not quaternions:
            return self
        compared = None if self.components is None else {*self.components}
        whole = tuple(w for w in quaternions if compared is None or {w, w + 1, w + 2, w + 3} <= compared)
        return dataclasses.replace(self, quaternions=whole)

    def added_units(self, units: Sequence[str]) -> tuple[str, ...]:
        """Return the units of the states that the norm adds; none if it has weights or scales."""
        if self.weights is not None or self.scales is not None:
            return ()
        compared = range(len(units)) if self.components is None else self.components
        places = [i for i in compared if not isinstance(i, str) and -len(units) <= i < len(units)]
        return tuple(dict.fromkeys(units[i] for i in places if units[i]))

    def describe(self) -> dict[str, Any]:
        names, unusual = (
            [field.name for field in dataclasses.fields(self)],
            ("weights", "scales", "angles", "quaternions"),
        )
        described = {name: getattr(self, name) for name in names if name not in unusual}
        if (factors := self.factors) is not None:
            described["factors"] = factors
        return described | {name: given for name in unusual[2:] if len(given := getattr(self, name))}


@dataclass(frozen=True)
class ErrorNorm(StateNorm, ABC):
    """Norm of an error vector of the trajectories of one task; see :class:`StateNorm` for the attributes."""

    @abstractmethod
    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the error vector, shape ``(..., k)``; the distance is its norm."""

    def compose(self, error: Array) -> Array:
        """Return the norms of error vectors ``(..., k)``, shape ``(...)``."""
        return np.asarray(np.linalg.norm(error, self.norm, axis=-1))

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        return self.compose(self.error(model_trajectory, system_trajectory, task))


def turned(angles: Array) -> Array:
    """Return angles in radians, moved by whole turns to at most pi in magnitude; smaller ones are unchanged."""
    return np.asarray(angles - 2 * np.pi * np.round(angles / (2 * np.pi)))


def require_numbers(name: str, given: ArrayLike | None, components: Sequence[int | str] | None, *, zero: bool) -> None:
    """Check that an option is None, or a list of positive numbers (some 0 with ``zero``), one for each component."""
    if given is None:
        return
    array = as_finite(name, given)
    if array.ndim != 1 or not array.size or (components is not None and len(array) != len(components)):
        wanted = "state" if components is None else f"of {len(components)} states"
        raise ShapeError(f"{name} must be a list with one number for each {wanted}, got {given!r}.")
    valid = (array >= 0).all() and array.any() if zero else (array > 0).all()
    if not valid:
        wanted = "numbers >= 0, not all of them 0" if zero else "positive numbers"
        raise InputError(f"{name} must be {wanted}, got {given!r}.")


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
        norm, components, weights, scales, angles, quaternions: as in :class:`StateNorm`.
        times: seconds after the start of the task; each is rounded to the nearest step.
    """

    monotone: ClassVar[bool] = True

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

    monotone: ClassVar[bool] = True

    norm: Norm = 2

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        return np.asarray(self.norms(system_trajectory.states, model_trajectory.states).max(axis=-1))


@part()
@dataclass(frozen=True)
class MeanDeviation(StateNorm):
    """Mean over the times 1..H of the norm of the difference between the states, such as an average in metres.

    :class:`StateNorm` has the attributes; the norm is that over the states at one time.
    """

    monotone: ClassVar[bool] = True

    norm: Norm = 2

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        return np.asarray(self.norms(system_trajectory.states, model_trajectory.states)[..., 1:].mean(axis=-1))


@part()
@dataclass(frozen=True)
class RelativeDeviation(StateNorm):
    """Maximum over time of the norm of relative errors: the gap of each state, divided by its range on the model.

    The range is that of the state in the trajectory of M for the same task. The distance has no unit: 0.1 means that S
    is away from M by a tenth of the model's own motion.

    Attributes:
        norm, components, weights, scales, angles, quaternions: as in :class:`StateNorm`.
        least: smallest range that a gap is divided by, for each compared state in its unit; a state at rest would
            otherwise have an unbounded relative error.
    """

    monotone: ClassVar[bool] = True

    norm: Norm = np.inf
    least: Sequence[float] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        require_numbers("least", self.least, self.components, zero=False)

    def added_units(self, units: Sequence[str]) -> tuple[str, ...]:
        return ()

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        gap = self.difference(system_trajectory.states, model_trajectory.states)
        states = model_trajectory.states
        moved = np.ptp(states, axis=-2)
        if len(self.quaternions):
            moved = np.ptp(self.gap(states, states[..., :1, :]), axis=-2)
            moved[..., self._geometry(states.shape[-1]).quaternions] = 1.0  # the gap of w is 0
        ranges = np.maximum(selected(moved, self.components), np.asarray(self.least, dtype=np.float64))
        return np.asarray(np.linalg.norm(gap / ranges[..., None, :], self.norm, axis=-1).max(axis=-1))


@part()
@dataclass(frozen=True)
class WholeTrajectory(StateNorm):
    """Norm of the difference between whole trajectories, taken as one long vector.

    With ``norm=inf`` it is the distance of the paper's OLDT and CCDT. With ``norm=2, per_step=True`` it is the formula
    printed for the Dubins car, ``1/H ||xi_S - xi_M||_2``.

    Attributes:
        norm, components, weights, scales, angles, quaternions: as in :class:`StateNorm`.
        per_step: whether the norm is divided by the horizon H.
    """

    monotone: ClassVar[bool] = True

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
        norm, components, weights, scales, angles, quaternions: as in :class:`StateNorm`.
        over: ``maximum`` or ``mean``: how the norms at the times are combined.
    """

    to_task: ClassVar[bool] = True

    norm: Norm = 2
    over: Literal["maximum", "mean"] = "maximum"

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        norms = self.norms(system_trajectory.states, task.reference)[..., 1:]
        return np.asarray(norms.max(axis=-1) if self.over == "maximum" else norms.mean(axis=-1))


Direction = Literal["up", "down", "either"]


@part()
@dataclass(frozen=True)
class AtCrossing(ErrorNorm):
    """Largest norm of the difference between the states at which M and S first cross a level, such as a gate.

    The k-th crossing of S is compared with the k-th crossing of M, interpolated between two samples. A trajectory that
    does not cross so often is compared at its final state.

    Attributes:
        norm, components, weights, scales, angles, quaternions: as in :class:`StateNorm`. An angle crosses the level on
            the circle.
        state: index or name of the state that crosses the level.
        level: the level, in the unit of this state.
        direction: ``up``, ``down`` or ``either``: the direction in which the state crosses the level.
        crossings: number of crossings that are compared; only the first one by default.
    """

    norm: Norm = 2
    state: int | str = 0
    level: FiniteFloat = 0.0
    direction: Direction = "either"
    crossings: PositiveInt = 1

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        gap = self.difference(self._states(system_trajectory), self._states(model_trajectory))
        return np.asarray(gap.reshape(*gap.shape[:-2], -1))

    def compose(self, error: Array) -> Array:
        gap = error.reshape(*error.shape[:-1], self.crossings, -1)
        return np.asarray(np.linalg.norm(gap, self.norm, axis=-1).max(axis=-1))

    def _states(self, trajectory: Trajectory) -> Array:
        states = trajectory.states
        n = states.shape[-1]
        [state] = require_indices("state", [self.state], n)
        on_circle = state % n in {index % n for index in require_indices("angles", self.angles, n)}
        places = _crossings(states[..., state] - self.level, self.direction, self.crossings, on_circle)
        before = np.minimum(places.astype(np.intp), trajectory.horizon - 1)[..., None]
        first = np.take_along_axis(states, before, axis=-2)
        second = np.take_along_axis(states, before + 1, axis=-2)
        part = (places[..., None] - before) * self.gap(second, first)
        return self._geometry(n).add(first, part)


@part()
@dataclass(frozen=True)
class CrossingTime(NamedStates):
    """Difference in seconds between the times at which M and S first cross a level; interpolated between samples.

    A trajectory that does not cross the level counts as if it crossed it at its end.
    """

    state: int | str = 0  #: index or name of the state that crosses the level, which is in the unit of this state
    level: FiniteFloat = 0.0
    #: ``up``, ``down`` or ``either``: the direction in which the state crosses the level
    direction: Direction = "either"
    angle: bool = False  #: whether the state is an angle in radians, which crosses the level on the circle

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        [state] = require_indices("state", [self.state], model_trajectory.states.shape[-1])
        places = [
            _crossings(trajectory.states[..., state] - self.level, self.direction, 1, self.angle)[..., 0]
            for trajectory in (system_trajectory, model_trajectory)
        ]
        return np.asarray(np.abs(places[0] - places[1]) * task.dt)


def _crossings(above: Array, direction: Direction, count: int, on_circle: bool) -> Array:
    """Return the places of the first crossings of 0 in steps, ``(..., count)``; the last step if there is none."""
    if on_circle:
        above = turned(above)
    first, second = above[..., :-1], above[..., 1:]
    up, down = (first < 0) & (second >= 0), (first > 0) & (second <= 0)
    crossed = {"up": up, "down": down, "either": up | down}[direction]
    if on_circle:
        crossed &= np.abs(second - first) < np.pi  # a larger step passes the opposite point of the circle
    with np.errstate(all="ignore"):
        places = np.arange(first.shape[-1]) + first / (first - second)
    numbers = np.cumsum(crossed, axis=-1)
    first_places = []
    for number in range(1, count + 1):
        at = crossed & (numbers == number)
        place = np.take_along_axis(places, at.argmax(axis=-1)[..., None], axis=-1)[..., 0]
        first_places.append(np.where(at.any(axis=-1), place, float(first.shape[-1])))
    return np.stack(first_places, axis=-1)
