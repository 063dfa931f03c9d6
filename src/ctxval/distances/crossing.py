"""Distances at the events at which a state crosses a level, which M and S may reach at different times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import FiniteFloat, Norm, PositiveInt
from ctxval._util.registry import part
from ctxval.core.distance import NamedStates, require_indices
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.deviations import ErrorNorm, turned

Direction = Literal["up", "down", "either"]


@part()
@dataclass(frozen=True)
class AtCrossing(ErrorNorm):
    """Largest norm of the difference between the states at which M and S first cross a level, such as a gate.

    The k-th crossing of S is compared with the k-th crossing of M, interpolated between two samples. A trajectory that
    does not cross so often is compared at its final state.

    Attributes:
        norm, components, weights, scales, angles: as in :class:`StateNorm`. An angle crosses the level on the circle.
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
        return np.asarray(first + (places[..., None] - before) * self.unwrapped(second - first))


@part()
@dataclass(frozen=True)
class CrossingTime(NamedStates):
    """Difference in seconds between the times at which M and S first cross a level; interpolated between samples.

    A trajectory that does not cross the level counts as if it crossed it at its end.

    Attributes:
        state: index or name of the state that crosses the level, which is in the unit of this state.
        direction: ``up``, ``down`` or ``either``: the direction in which the state crosses the level.
        angle: whether the state is an angle in radians, which crosses the level on the circle.
    """

    state: int | str = 0
    level: FiniteFloat = 0.0
    direction: Direction = "either"
    angle: bool = False

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
