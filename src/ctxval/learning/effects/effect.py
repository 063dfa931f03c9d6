"""What an effect is that a model lacks, and what it acts on.

A robot is its sensors around its mechanics around its actuators. An effect changes one of the three: the inputs that
act for those that are commanded, the next state, or what is recorded of a state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from ctxval.learning.effects.flow import Flow
from ctxval.learning.effects.plant import Plant


@dataclass(frozen=True)
class Effect(ShortRepr):
    """Something that a model lacks, with sizes in physical units. A subclass changes one of the hooks, for batches."""

    sizes: tuple[float, ...]
    name: ClassVar[str]  #: what it is in two or three words
    remembers: ClassVar[bool] = False  #: whether inputs that act depend on earlier ones, so that no step has it

    def with_sizes(self, sizes: Sequence[float]) -> Effect:
        """Return the effect with other sizes."""
        return replace(self, sizes=tuple(float(size) for size in sizes))

    @property
    def kind(self) -> Effect:
        """The effect without its sizes: two effects of one kind are one effect."""
        return replace(self, sizes=())

    def model(self, model: Model) -> Model:
        """Return the model of the mechanics."""
        return model

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        """Return the inputs that act ``(..., m)`` for those of effects before, and a memory; None at the first step.

        If they change while a step goes on, they are those of its parts ``(..., parts, m)``.
        """
        return u, memory

    def duration(self, model: Model) -> float:
        """Return the steps of a model of the mechanics that a step of the system takes."""
        return 1.0

    def within(self, flow: Flow) -> Flow:
        """Return the flow of a step for the flow without this effect."""
        return flow

    def seeing(self, controller: Controller) -> Controller:
        """Return a controller that sees what this effect lets it see of the records."""
        return controller

    def true(self, recorded: Array) -> Array:
        """Return the states ``(..., n)`` of which these are recorded."""
        return recorded

    def recorded(self, x: Array) -> Array:
        """Return what is recorded of states ``(..., n)``."""
        return x

    def gap(self, difference: Array) -> Array:
        """Return differences of recorded states ``(..., n)`` as they are to be compared."""
        return difference

    def text(self, plant: Plant) -> str:
        """Return what it is with its sizes and units: a clause without a full stop."""
        raise NotImplementedError

    def python(self) -> str:
        """Return the Python expression that makes it."""
        given = [f"{name}={value!r}" for name, value in vars(self).items() if name != "sizes"]
        sizes = f"({', '.join(f'{size:.6g}' for size in self.sizes)}{',' if len(self.sizes) == 1 else ''})"
        text = f"causes.{type(self).__name__}({', '.join([sizes, *given])})"
        return text.replace("Joint(rate", "causes.Joint(rate")

    def mjcf(self, plant: Plant) -> str | None:
        """Return the line of MJCF that puts it into a MuJoCo model; None if there is none."""
        return None


@dataclass(frozen=True)
class EffectCandidate(ShortRepr):
    """An effect whose sizes are to be fitted."""

    effect: Effect
    low: tuple[float, ...] = ()  #: bounds of the sizes
    high: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()  #: changes of the sizes that matter, for the steps of the fit
    starts: tuple[tuple[float, ...], ...] = ((),)  #: first guesses, of which the best one is refined


def of_size(effect: Effect, low: float, high: float, scale: float, *starts: float) -> EffectCandidate:
    """Return a candidate with one size."""
    return EffectCandidate(effect, (low,), (high,), (scale,), tuple((start,) for start in starts))


def of_ratio(effect: Effect) -> EffectCandidate:
    """Return a candidate whose size is a ratio."""
    return of_size(effect, 0.1, 10.0, 0.1, 0.95, 1.1)


@dataclass(frozen=True)
class OfInput(Effect):
    """An effect in one input. A subclass has the formula of what acts, and the sentence."""

    input: int = 0
    sentence: ClassVar[str]  #: with the ``name`` and ``unit`` of the input and the ``size``; ``play`` is twice the size

    def acts(self, u: Array, before: Array) -> Array:
        """Return what acts ``(...)`` for what is commanded of the input, and what acted before, 0 at first."""
        raise NotImplementedError

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        acting = np.array(u, dtype=np.float64)
        before = np.zeros_like(acting) if memory is None else memory
        acting[..., self.input] = self.acts(acting[..., self.input], before[..., self.input])
        return acting, acting if self.remembers else None

    def text(self, plant: Plant) -> str:
        (name, unit), (size,) = plant.inputs[self.input], self.sizes or (0.0,)
        return self.sentence.format(name=name, unit=unit, size=size, play=2 * size).rstrip()


def at_index(values: Array, index: int | list[int] | None, size: float, elsewhere: float = 0.0) -> Array:
    """Return an array of the last axis of values with a size at some places, or everywhere if the index is None."""
    sizes = np.full(values.shape[-1], elsewhere)
    sizes[slice(None) if index is None else index] = size
    return sizes


def seconds_text(seconds: float) -> str:
    """Return a duration in seconds, or in milliseconds if it is below one."""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def exchanged(values: Array, first: Sequence[int], second: Sequence[int]) -> Array:
    """Return values with some places of the last axis exchanged for others."""
    order = np.arange(values.shape[-1])
    order[[*first, *second]] = [*second, *first]
    return values[..., order]
