"""Effects in sensors: what is recorded is not the state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.turns import turns
from ctxval.core.model import Function, Model
from ctxval.learning.effects.effect import (
    Effect,
    EffectCandidate,
    Observed,
    Parameter,
    Size,
    at_index,
    exchanged,
    of_ratio,
    of_size,
)
from ctxval.learning.effects.plant import Plant


@dataclass(frozen=True)
class SensorOffset(Effect):
    """A state is recorded with an offset. Size: what is recorded minus the state."""

    name: ClassVar[str] = "sensor offset"
    state: int = 0

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        for first, *_ in _groups(observed):
            size = max(float(np.ptp(observed.x[:, first])), 1e-9)
            unit = observed.plant.states[first][1]
            yield of_size(cls((0.0,), first), Parameter(cls.name, -size, size, 0.05 * size, unit), 0.0)

    def true(self, recorded: Array) -> Array:
        return recorded - at_index(recorded, self.state, self.sizes[0])

    def recorded(self, x: Array) -> Array:
        return x + at_index(x, self.state, self.sizes[0])

    def sentence(self, plant: Plant) -> str:
        name, unit = plant.states[self.state]
        size = f"{abs(self.sizes[0]):.3g} {unit}".rstrip()
        return f"the sensor of {name} reads {size} too {'much' if self.sizes[0] > 0 else 'little'}"


@dataclass(frozen=True)
class SensorScale(Effect):
    """A position and its rate are recorded with a wrong scale. Size: what is recorded, divided by the state."""

    name: ClassVar[str] = "sensor scale"
    states: tuple[int, ...] = (0,)  #: indices of the states that are scaled

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        for group in _groups(observed):
            yield of_ratio(cls((1.0,), group))

    def true(self, recorded: Array) -> Array:
        return recorded / at_index(recorded, list(self.states), self.sizes[0], 1.0)

    def recorded(self, x: Array) -> Array:
        return x * at_index(x, list(self.states), self.sizes[0], 1.0)

    def sentence(self, plant: Plant) -> str:
        return f"the sensor of {plant.states[self.states[0]][0]} reads {self.sizes[0]:.3g} times the value"


@dataclass(frozen=True)
class WrappedAngle(Effect):
    """The system keeps an angle within a turn, and M does not; or M does, and the system does not."""

    sizes: tuple[Size, ...] = ()
    name: ClassVar[str] = "wrapped angle"
    state: int = 0
    turn: float = 2 * np.pi
    low: float = -np.pi  #: the least value of the angle
    of_model: bool = False  #: whether it is M that keeps the angle within the turn

    def model(self, model: Model) -> Model:
        if not self.of_model:
            return model
        return Function(lambda x, u: x + self.gap(np.asarray(model.step(x, u)) - x), vectorized=True)

    def recorded(self, x: Array) -> Array:
        if self.of_model:
            return x
        inside = np.array(x)
        inside[..., self.state] = self.low + (x[..., self.state] - self.low) % self.turn
        return inside

    def gap(self, difference: Array) -> Array:
        return difference - at_index(difference, self.state, self.turn) * np.round(difference / self.turn)

    def sentence(self, plant: Plant) -> str:
        name, pi = plant.states[self.state][0], self.turn < 7
        whole, half = ("2 pi", "pi") if pi else ("360", "180")
        ends = f"0 to {whole}" if self.low == 0 else f"-{half} to {half}"
        keeps = "M, unlike the system, keeps" if self.of_model else "the system, unlike M, keeps"
        return f"{keeps} {name} within {ends}, with jumps of {whole}"


@dataclass(frozen=True)
class SwappedJoints(Effect):
    """The recorded states of two joints are exchanged."""

    sizes: tuple[Size, ...] = ()
    name: ClassVar[str] = "swapped joints"
    first: tuple[int, ...] = (0,)  #: indices of their states, in the same order
    second: tuple[int, ...] = (1,)

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        moving = [group for group in _groups(observed) if np.ptp(observed.x[:, group[0]]) > 0]
        pairs = [group for group in moving if len(group) == len(moving[0])]
        for first, second in combinations(pairs, 2):
            yield EffectCandidate(cls((), first, second))

    def true(self, recorded: Array) -> Array:
        return exchanged(recorded, self.first, self.second)

    def recorded(self, x: Array) -> Array:
        return self.true(x)

    def sentence(self, plant: Plant) -> str:
        return f"the sensors of {plant.states[self.first[0]][0]} and {plant.states[self.second[0]][0]} are exchanged"


def _groups(observed: Observed) -> list[tuple[int, ...]]:
    """Return the states that one sensor measures: a position and its rate, or a rate alone."""
    joints = () if observed.estimated else observed.plant.joints
    return [(joint.rate,) if joint.position is None else (joint.position, joint.rate) for joint in joints]


def wrapped_angles(x: Sequence[Array], following: Sequence[Array]) -> Iterator[EffectCandidate]:
    """Yield the states that jump by a turn in runs ``(H + 1, n)`` or in M's next states ``(H, n)`` along them alone."""
    gaps = [each - run[1:] for each, run in zip(following, x, strict=True)]
    for state in range(x[0].shape[1]):
        columns, apart = [run[:, state] for run in x], np.abs(np.concatenate(gaps)[:, state])
        turn, _ = turns(columns)
        of_model, columns = not turn, columns if turn else [each[:, state] for each in following]
        turn = turn or turns(columns)[0]
        far = apart[apart > 0.5 * turn]
        if turn and len(far) and (np.abs(far - turn * np.round(far / turn)) < 0.25 * turn).all():
            low = -0.5 * turn if min(column.min() for column in columns) < -0.02 * turn else 0.0
            yield EffectCandidate(WrappedAngle((), state, turn, low, of_model))
