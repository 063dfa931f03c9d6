"""Steps of the model that take another time than those of the system."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

from ctxval.core.model import Model
from ctxval.learning.effects.effect import Effect, EffectCandidate, Observed, Parameter, Size, of_size
from ctxval.learning.effects.plant import Plant
from ctxval.models import MuJoCo


@dataclass(frozen=True)
class TimeStep(Effect):
    """A step of M takes another time than that of the system. Size: the steps of M in one step of the system."""

    name: ClassVar[str] = "time step"

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        yield of_size(cls((1.0,)), Parameter(cls.name, 0.2, 5.0, 0.1, "steps"), 0.5, 0.95, 1.05, 2.0)

    def duration(self, model: Model) -> Size:
        return 1.0 if isinstance(model, MuJoCo) else self.sizes[0]

    def model(self, model: Model) -> Model:
        if not isinstance(model, MuJoCo):
            return model
        substeps = max(1, round(float(self.sizes[0]) * model.substeps))

        def change(compiled: Any) -> None:
            compiled.opt.timestep *= self.sizes[0] * model.substeps / substeps

        changed = model.changed(change)
        changed.substeps = substeps
        return changed

    def sentence(self, plant: Plant) -> str:
        step, taken = 1e3 * plant.dt, 1e3 * plant.dt * self.sizes[0]
        return f"one step of the system takes {taken:.4g} ms of M, and not {step:.4g} ms"
