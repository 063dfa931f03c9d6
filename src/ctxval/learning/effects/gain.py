"""Inputs with another gain or sign, or exchanged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import (
    Effect,
    EffectCandidate,
    Observed,
    OfInput,
    Size,
    at_index,
    exchanged,
    of_ratio,
)
from ctxval.learning.effects.plant import Plant


@dataclass(frozen=True)
class InputGain(Effect):
    """An input has more or less effect: a weak motor, or a wrong constant. Size: the share of its effect in M."""

    name: ClassVar[str] = "input gain"
    input: int | None = 0  #: index of the input; None for all of them together

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        m = len(observed.plant.inputs)
        for k in (*range(m), *([None] if m > 1 else [])):
            yield of_ratio(cls((1.0,), k))

    def act(self, u: Array, memory: Array) -> tuple[Array, Array]:
        return u * at_index(u, self.input, self.sizes[0], 1.0), memory

    def sentence(self, plant: Plant) -> str:
        which = "all inputs have" if self.input is None else f"{plant.inputs[self.input][0]} has"
        return f"{which} {self.sizes[0]:.3g} times the effect that M has"

    def repair(self, plant: Plant) -> dict[str, str]:
        if plant.compiled is None or self.input is None:
            return {}
        gear = self.sizes[0] * float(plant.compiled.actuator_gear[self.input, 0])
        return {"mjcf": f'<motor name="{plant.compiled.actuator(self.input).name}" gear="{gear:.5g}"/>'}


@dataclass(frozen=True)
class ReversedInput(OfInput):
    """An input acts with the opposite sign."""

    sizes: tuple[Size, ...] = ()
    name: ClassVar[str] = "reversed input"
    words: ClassVar[str] = "{name} acts with the opposite sign"

    @classmethod
    def of_input(cls, k: int, most: float, observed: Observed) -> EffectCandidate:
        return EffectCandidate(cls((), k))

    def acts(self, u: Array, before: Array) -> Array:
        return -u


@dataclass(frozen=True)
class SwappedInputs(Effect):
    """Two inputs are exchanged."""

    sizes: tuple[Size, ...] = ()
    name: ClassVar[str] = "swapped inputs"
    first: int = 0
    second: int = 1

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        for first, second in combinations(range(len(observed.plant.inputs)), 2):
            yield EffectCandidate(cls((), first, second))

    def act(self, u: Array, memory: Array) -> tuple[Array, Array]:
        return exchanged(u, [self.first], [self.second]), memory

    def sentence(self, plant: Plant) -> str:
        return f"the inputs {plant.inputs[self.first][0]} and {plant.inputs[self.second][0]} are exchanged"
