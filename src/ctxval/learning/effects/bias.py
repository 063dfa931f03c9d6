"""A constant or a drift that is added to an input, or a constant force on a joint."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import EffectCandidate, Observed, OfInput, Parameter, of_size
from ctxval.learning.effects.force import Force, force_parameter
from ctxval.learning.effects.plant import Joint, Plant


@dataclass(frozen=True)
class InputOffset(OfInput):
    """An input has an offset. Size: the offset, in units of the input."""

    name: ClassVar[str] = "input offset"
    words: ClassVar[str] = "{name} has an offset of {size:.3g} {unit}"

    @classmethod
    def of_input(cls, k: int, most: float, observed: Observed) -> EffectCandidate:
        unit = observed.plant.inputs[k][1]
        return of_size(cls((0.0,), k), Parameter(cls.name, -2 * most, 2 * most, 0.05 * most, unit), 0.0)

    def acts(self, u: Array, before: Array) -> Array:
        return u + self.sizes[0]


@dataclass(frozen=True)
class InputDrift(OfInput):
    """The offset of an input grows with the time of an execution. Size: its change in a second."""

    name: ClassVar[str] = "input drift"
    holds: ClassVar[bool] = True  # the time
    words: ClassVar[str] = "the offset of {name} drifts by {size:.3g} {unit} in a second"
    dt: float = 1.0  #: seconds

    @classmethod
    def of_input(cls, k: int, most: float, observed: Observed) -> EffectCandidate:
        rate, unit = most / observed.seconds, f"{observed.plant.inputs[k][1]}/s"
        size = Parameter(cls.name, -2 * rate, 2 * rate, 0.05 * rate, unit)
        return of_size(cls((0.0,), k, observed.plant.dt), size, 0.0)

    def act(self, u: Array, memory: Array) -> tuple[Array, Array]:
        acting = np.array(u, dtype=np.float64)
        acting[..., self.input] += self.sizes[0] * memory[..., 0]
        return acting, memory + self.dt


@dataclass(frozen=True)
class Bias(Force):
    """A constant force. Size: the force."""

    name: ClassVar[str] = "bias"

    @classmethod
    def on_joint(
        cls, observed: Observed, where: tuple[Joint, float, float], force: float, speed: float
    ) -> Iterator[EffectCandidate]:
        joint = where[0]
        if joint.input is None or joint.dof is not None:  # otherwise it is an offset of the input
            yield of_size(cls((0.0,), *where), force_parameter(observed, joint, cls.name, force, both=True), 0.0)

    def force(self, before: Array, rate: Array, load: Array | float, stopping: Array) -> Array:
        return np.broadcast_to(self.sizes[0], stopping.shape)

    def sentence(self, plant: Plant) -> str:
        return f"{plant.joint_name(self.joint)} is pushed by a constant {self.amount(plant, self.sizes[0])}"
