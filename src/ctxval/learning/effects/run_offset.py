"""Offsets that stay the same for a whole execution, and are others in each: of a sensor, or of an input."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.learning.effects.bias import InputOffset
from ctxval.learning.effects.effect import Effect, EffectCandidate, Observed, Size
from ctxval.learning.effects.plant import Plant
from ctxval.learning.effects.sensor import SensorOffset


@dataclass(frozen=True)
class RunOffset(Effect):
    """A sensor or an input has another offset in each execution. Sizes: those of the executions, in their order.

    For an execution that is not known, it is their mean.
    """

    name: ClassVar[str] = "offset of a run"
    offset: Effect = SensorOffset((0.0,))  # noqa: RUF009  # it is frozen  #: what has it

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        k = observed.runs
        for kind in (SensorOffset, InputOffset) if k > 1 else ():
            for each in kind.candidates(observed):
                yield EffectCandidate(cls((0.0,) * k, each.effect), each.parameters * k, (each.starts[0] * k,))

    def in_run(self, run: int | Rows) -> Effect:
        if isinstance(run, int):
            return self.offset.with_sizes([self.sizes[run]])
        each = np.concatenate([np.reshape(size, (*np.shape(size)[:1], 1)) for size in self.sizes], axis=-1)
        return self.offset.with_sizes([each[..., run]])

    @property
    def _mean(self) -> Effect:
        mean: Size = sum(self.sizes) / len(self.sizes)
        return self.offset.with_sizes([mean])

    def act(self, u: Array, memory: Array) -> tuple[Array, Array]:
        return self._mean.act(u, memory)

    def true(self, recorded: Array) -> Array:
        return self._mean.true(recorded)

    def recorded(self, x: Array) -> Array:
        return self._mean.recorded(x)

    def python(self) -> str:
        return super().python().replace("offset=", "offset=causes.")

    def sentence(self, plant: Plant) -> str:
        if isinstance(self.offset, SensorOffset):
            (name, unit), what = plant.states[self.offset.state], "the sensor of "
        else:
            (name, unit), what = plant.inputs[getattr(self.offset, "input", 0)], ""
        low, high = min(self.sizes), max(self.sizes)
        return f"{what}{name} has another offset in each execution ({low:.3g} to {high:.3g} {unit}".rstrip() + ")"
