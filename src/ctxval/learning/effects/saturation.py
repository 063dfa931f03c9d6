"""Inputs that are limited, or that change with a limited rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import EffectCandidate, Observed, OfInput, Parameter, of_size
from ctxval.learning.effects.plant import Plant


@dataclass(frozen=True)
class Saturation(OfInput):
    """An input is limited. Size: the limit of its magnitude."""

    name: ClassVar[str] = "saturation"
    kinked: ClassVar[bool] = True
    words: ClassVar[str] = "{name} saturates at {size:.3g} {unit}"

    @classmethod
    def of_input(cls, k: int, most: float, observed: Observed) -> EffectCandidate:
        size = Parameter(cls.name, 1e-3 * most, most, 0.05 * most, observed.plant.inputs[k][1])
        return of_size(cls((most,), k), size, *(share * most for share in (0.9, 0.7, 0.5, 0.3, 0.1, 0.03, 0.01)))

    def acts(self, u: Array, before: Array) -> Array:
        return np.clip(u, -self.sizes[0], self.sizes[0])

    def repair(self, plant: Plant) -> dict[str, str]:
        if plant.compiled is None:
            return {}
        limit = f'ctrllimited="true" ctrlrange="{-self.sizes[0]:.5g} {self.sizes[0]:.5g}"'
        effort = self.sizes[0] * abs(float(plant.compiled.actuator_gear[self.input, 0]))
        return {
            "mjcf": f'<motor name="{plant.compiled.actuator(self.input).name}" {limit}/>',
            "urdf": f'<limit effort="{effort:.5g}"/>',
        }


@dataclass(frozen=True)
class RateLimit(OfInput):
    """An input follows with a limited rate. Size: its largest change in a second."""

    name: ClassVar[str] = "rate limit"
    holds: ClassVar[bool] = True
    words: ClassVar[str] = "{name} changes by at most {size:.3g} {unit} in a second"
    dt: float = 1.0  #: seconds

    @classmethod
    def of_input(cls, k: int, most: float, observed: Observed) -> EffectCandidate:
        fastest = 2 * most / observed.plant.dt  # from one end to the other in a step
        size = Parameter(cls.name, 1e-3 * fastest, fastest, 0.02 * fastest, f"{observed.plant.inputs[k][1]}/s")
        starts = (share * fastest for share in (0.3, 0.1, 0.03, 0.01))
        return of_size(cls((fastest,), k, observed.plant.dt), size, *starts)

    def acts(self, u: Array, before: Array) -> Array:
        most = self.sizes[0] * self.dt
        return before + np.clip(u - before, -most, most)
