"""A model with uncertain parameters and effects of uncertain sizes, such as a delay or friction in joints."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.core.uncertain import UncertainModel, UncertainParameter
from ctxval.learning.effects.effect import EffectCandidate, all_sized
from ctxval.learning.effects.model import ModelWithEffects
from ctxval.learning.effects.mujoco import SharedAttribute
from ctxval.models import MuJoCo


@dataclass(frozen=True, eq=False)
class UncertainEffects(ShortRepr):
    """A model with uncertain parameters and effects of its m inputs; their sizes are further parameters.

    Attributes that many elements of an MJCF share are effects, too.

    The prior of a size is normal around that of the effect, with a deviation of five of its scales.
    """

    given: UncertainModel
    effects: tuple[EffectCandidate, ...]
    inputs: int

    @functools.cached_property
    def uncertain(self) -> tuple[UncertainParameter, ...]:
        """The parameters of the model, and the sizes of the effects."""
        sizes = [
            UncertainParameter(parameter.name, float(size), 5 * parameter.scale, relative=False, low=parameter.low)
            for each in self.effects
            for parameter, size in zip(each.parameters, each.effect.sizes, strict=True)
        ]
        return *self.given.uncertain, *sizes

    @functools.cached_property
    def _with_attributes(self) -> UncertainModel:
        """The model whose uncertain parameters the shared attributes are, too, so that all draws run in one batch."""
        shared = [each.effect for each in self.effects if isinstance(each.effect, SharedAttribute)]
        if not shared or not isinstance(self.given, MuJoCo):
            return self.given
        return self.given.with_uncertain({each.parameter: each.unit for each in shared})

    def drawn(self, z: Array) -> Model:
        """Return S models with standardised parameters ``(S, K)``; see :class:`UncertainModel`."""
        of_model = len(self.given.uncertain)
        sizes = (each.at(z[:, k, None]) for k, each in enumerate(self.uncertain) if k >= of_model)
        effects = [each.effect for each in all_sized(self.effects, sizes)]
        shared = [each.standardised for each in effects if isinstance(each, SharedAttribute)]
        model = self._with_attributes.drawn(np.concatenate([z[:, :of_model], *shared], axis=1))
        of_inputs = tuple(each for each in effects if not isinstance(each, SharedAttribute))
        return ModelWithEffects(model, of_inputs, self.inputs) if of_inputs else model

    @functools.cached_property
    def _usual(self) -> ModelWithEffects:
        return ModelWithEffects(self.given, tuple(each.effect for each in self.effects), self.inputs)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states with the usual sizes; effects that remember are left out."""
        return self._usual.step(x, u)

    def start(self, x: Array) -> Array:
        """Return the memory ``(..., k)`` of closed loops that start in states ``(..., n)``."""
        return self._usual.start(x)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states and the new memory, as :class:`ctxval.core.model.ModelWithMemory`."""
        return self._usual.advance(x, u, memory)
