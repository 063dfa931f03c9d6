"""Causes in the sensors: what is recorded is not the state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.studies.causes.cause import Cause
from ctxval.studies.causes.plant import Plant


@dataclass(frozen=True)
class SensorOffset(Cause):
    """A state is recorded with an offset. Size: what is recorded minus the state."""

    name: ClassVar[str] = "sensor offset"
    state: int = 0

    def true(self, recorded: Array) -> Array:
        shifted = np.array(recorded)
        shifted[..., self.state] -= self.sizes[0]
        return shifted

    def recorded(self, x: Array) -> Array:
        shifted = np.array(x)
        shifted[..., self.state] += self.sizes[0]
        return shifted

    def text(self, plant: Plant) -> str:
        name, unit = plant.state(self.state)
        return f"the sensor of {name} reads {abs(self.sizes[0]):.3g} {unit}".rstrip() + (
            " too much" if self.sizes[0] > 0 else " too little"
        )


@dataclass(frozen=True)
class SensorScale(Cause):
    """A position and its rate are recorded with a wrong scale. Size: what is recorded, divided by the state.

    Attributes:
        states: indices of the states that are scaled.
    """

    name: ClassVar[str] = "sensor scale"
    states: tuple[int, ...] = (0,)

    def true(self, recorded: Array) -> Array:
        return recorded / self._scale(recorded.shape[-1])

    def recorded(self, x: Array) -> Array:
        return x * self._scale(x.shape[-1])

    def _scale(self, n: int) -> Array:
        scale = np.ones(n)
        scale[list(self.states)] = self.sizes[0]
        return scale

    def text(self, plant: Plant) -> str:
        return f"the sensor of {plant.state(self.states[0])[0]} reads {self.sizes[0]:.3g} times the value"


@dataclass(frozen=True)
class SwappedJoints(Cause):
    """The recorded states of two joints are exchanged.

    Attributes:
        first, second: indices of their states, in the same order.
    """

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "swapped joints"
    first: tuple[int, ...] = (0,)
    second: tuple[int, ...] = (1,)

    def true(self, recorded: Array) -> Array:
        order = np.arange(recorded.shape[-1])
        order[[*self.first, *self.second]] = [*self.second, *self.first]
        return recorded[..., order]

    def recorded(self, x: Array) -> Array:
        return self.true(x)

    def text(self, plant: Plant) -> str:
        return f"the sensors of {plant.state(self.first[0])[0]} and {plant.state(self.second[0])[0]} are exchanged"
