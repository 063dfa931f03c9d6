"""A constant that is added to an input, or a constant force on a joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import OfInput
from ctxval.learning.effects.force import Force
from ctxval.learning.effects.plant import Plant


@dataclass(frozen=True)
class InputOffset(OfInput):
    """An input has an offset. Size: the offset, in units of the input."""

    name: ClassVar[str] = "input offset"
    sentence: ClassVar[str] = "{name} has an offset of {size:.3g} {unit}"

    def acts(self, u: Array, before: Array) -> Array:
        return u + self.sizes[0]


@dataclass(frozen=True)
class Bias(Force):
    """A constant force. Size: the force."""

    name: ClassVar[str] = "bias"

    def force(self, rate: Array, load: Array | float, stopping: Array) -> Array:
        return np.full_like(stopping, self.sizes[0])

    def text(self, plant: Plant) -> str:
        return f"{plant.joint_name(self.joint)} is pushed by a constant {self.amount(plant, self.sizes[0])}"
