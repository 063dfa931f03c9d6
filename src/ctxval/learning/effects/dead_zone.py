"""Inputs without effect near 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import EffectCandidate, Observed, OfInput, Parameter, of_size


@dataclass(frozen=True)
class DeadZone(OfInput):
    """An input has no effect near 0. Size: the magnitude below which it has none, and which is lost above."""

    name: ClassVar[str] = "dead zone"
    words: ClassVar[str] = "{name} has a dead zone of {size:.3g} {unit}"

    @classmethod
    def of_input(cls, k: int, most: float, observed: Observed) -> EffectCandidate:
        size = Parameter(cls.name, 0.0, most, 0.02 * most, observed.plant.inputs[k][1])
        return of_size(cls((0.0,), k), size, *(share * most for share in (0.01, 0.05, 0.15)))

    def acts(self, u: Array, before: Array) -> Array:
        return u - np.clip(u, -self.sizes[0], self.sizes[0])
