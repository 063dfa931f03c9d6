"""Inputs with another gain or sign, or exchanged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import Effect, OfInput, at_index, exchanged
from ctxval.learning.effects.plant import Plant


@dataclass(frozen=True)
class InputGain(Effect):
    """An input has more or less effect: a weak motor, or a wrong constant. Size: the share of its effect in M."""

    name: ClassVar[str] = "input gain"
    input: int | None = 0  #: index of the input; None for all of them together

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        return u * at_index(u, self.input, self.sizes[0], 1.0), None

    def text(self, plant: Plant) -> str:
        which = "all inputs have" if self.input is None else f"{plant.inputs[self.input][0]} has"
        return f"{which} {self.sizes[0]:.3g} times the effect that M has"

    def mjcf(self, plant: Plant) -> str | None:
        if plant.compiled is None or self.input is None:
            return None
        gear = self.sizes[0] * float(plant.compiled.actuator_gear[self.input, 0])
        return f'<motor name="{plant.compiled.actuator(self.input).name}" gear="{gear:.5g}"/>'


@dataclass(frozen=True)
class ReversedInput(OfInput):
    """An input acts with the opposite sign."""

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "reversed input"
    sentence: ClassVar[str] = "{name} acts with the opposite sign"

    def acts(self, u: Array, before: Array) -> Array:
        return -u


@dataclass(frozen=True)
class SwappedInputs(Effect):
    """Two inputs are exchanged."""

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "swapped inputs"
    first: int = 0
    second: int = 1

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        return exchanged(u, [self.first], [self.second]), None

    def text(self, plant: Plant) -> str:
        return f"the inputs {plant.inputs[self.first][0]} and {plant.inputs[self.second][0]} are exchanged"
