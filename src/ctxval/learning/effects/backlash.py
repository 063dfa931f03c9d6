"""Inputs that follow with play."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import EffectCandidate, Observed, OfInput, Parameter, of_size


@dataclass(frozen=True)
class Backlash(OfInput):
    """An input follows with play. Size: half of the play, in units of the input."""

    name: ClassVar[str] = "backlash"
    holds: ClassVar[bool] = True
    words: ClassVar[str] = "{name} has backlash of {play:.3g} {unit}"

    @classmethod
    def of_input(cls, k: int, most: float, observed: Observed) -> EffectCandidate:
        size = Parameter(cls.name, 0.0, most, 0.02 * most, observed.plant.inputs[k][1])
        return of_size(cls((0.0,), k), size, *(share * most for share in (0.01, 0.05, 0.15)))

    def acts(self, u: Array, before: Array) -> Array:
        return np.clip(before, u - self.sizes[0], u + self.sizes[0])
