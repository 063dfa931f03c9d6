"""Effects of inputs in their order: what acts for what a controller commands."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.learning.effects.effect import Effect, EffectCandidate, OfInput


@dataclass(frozen=True)
class InputEffects(ShortRepr):
    """Effects of inputs, the one that acts first before the others; without any, what is commanded acts."""

    effects: tuple[Effect, ...] = ()

    def remembered(self, inputs: int) -> int:
        """Return the number of values that all effects remember of so many inputs."""
        return sum(effect.remembered(inputs) for effect in self.effects)

    def act(self, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the inputs that act ``(..., m)``, see :meth:`Effect.act`, and what effects remember ``(..., k)``."""
        first, kept, inputs = 0, [memory[..., :0]], u.shape[-1]
        for effect in self.effects:
            last = first + effect.remembered(inputs)
            u, after = effect.act(u, memory[..., first:last])
            kept.append(after)
            first = last
        return u, np.concatenate(kept, axis=-1)

    def acting(self, inputs: Array) -> Array:
        """Return the inputs that act in each step, for commanded ones ``(..., H, m)``; see :meth:`Effect.act`."""
        return functools.reduce(lambda inputs, effect: effect.acting(inputs), self.effects, inputs)


NO_EFFECTS = InputEffects()


def labelled_sizes(found: tuple[EffectCandidate, ...], inputs: list[tuple[str, str]]) -> dict[str, float]:
    """Return the sizes of effects by their labels, such as ``dead zone of torque [N m]``.

    The inputs have names and units.
    """
    sizes = {}
    for each in found:
        effect = each.effect
        of = f" of {inputs[effect.input][0]}" if isinstance(effect, OfInput) else ""
        for parameter, size in zip(each.parameters, effect.sizes, strict=True):
            unit = f" [{parameter.unit}]" if parameter.unit else ""
            sizes[f"{parameter.name}{of}{unit}"] = float(size)
    return sizes
