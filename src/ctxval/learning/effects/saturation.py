"""Inputs that are limited."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import OfInput
from ctxval.learning.effects.plant import Plant


@dataclass(frozen=True)
class Saturation(OfInput):
    """An input is limited. Size: the limit of its magnitude."""

    name: ClassVar[str] = "saturation"
    sentence: ClassVar[str] = "{name} saturates at {size:.3g} {unit}"

    def acts(self, u: Array, before: Array) -> Array:
        return np.clip(u, -self.sizes[0], self.sizes[0])

    def mjcf(self, plant: Plant) -> str | None:
        if plant.compiled is None:
            return None
        limit = f'ctrllimited="true" ctrlrange="{-self.sizes[0]:.5g} {self.sizes[0]:.5g}"'
        return f'<motor name="{plant.compiled.actuator(self.input).name}" {limit}/>'
