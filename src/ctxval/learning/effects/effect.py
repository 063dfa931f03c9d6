"""What an effect is that a model lacks, and what it acts on.

A robot is its sensors around its mechanics around its actuators. An effect changes one of the three: the inputs that
act for those that are commanded, the next state, or what is recorded of a state.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from ctxval.learning.effects.flow import Flow
from ctxval.learning.effects.plant import Joint, Plant, drive

Size = float | Array
"""A number, or a number of each draw ``(S, 1)``, which broadcasts to one value for each draw and task ``(S, q)``."""


@dataclass(frozen=True)
class Effect(ShortRepr):
    """Something that a model lacks, with sizes in physical units. A subclass changes one of the hooks, for batches.

    If sizes are arrays, states ``(S, q, n)`` and inputs ``(S, q, m)`` have the draws as their first axis.
    """

    sizes: tuple[Size, ...]
    name: ClassVar[str]  #: what it is in two or three words
    kinked: ClassVar[bool] = False  #: whether what acts is no smooth function of what is commanded

    @classmethod
    def candidates(cls, observed: Observed) -> Iterable[EffectCandidate]:
        """Return the effects of this kind that recorded executions may have."""
        return ()

    def with_sizes(self, sizes: Sequence[Size]) -> Effect:
        """Return the effect with other sizes."""
        return replace(self, sizes=tuple(size if isinstance(size, np.ndarray) else float(size) for size in sizes))

    @property
    def kind(self) -> Effect:
        """The effect without its sizes: two effects of one kind are one effect."""
        return replace(self, sizes=())

    def remembered(self, inputs: int) -> int:
        """Return the number of values that it remembers of so many inputs; all are 0 before the first step."""
        return 0

    @property
    def remembers(self) -> bool:
        """Whether what acts depends on earlier steps, so that no single step has the effect."""
        return self.remembered(1) > 0

    @property
    def in_parts(self) -> bool:
        """Whether inputs that act change while a step goes on."""
        return False

    def act(self, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the inputs that act ``(..., m)`` for those of effects before, and the new memory ``(..., k)``.

        If they change while a step goes on, they are those of its parts ``(..., parts, m)``.
        """
        return u, memory

    def acting(self, inputs: Array) -> Array:
        """Return the inputs that act in each step, for commanded ones ``(..., H, m)``."""
        commands = np.moveaxis(inputs, -2, 0)
        if self.remembers:
            memory, steps = np.zeros((*commands.shape[1:-1], self.remembered(inputs.shape[-1]))), []
            for u in commands:
                acting, memory = self.act(u, memory)
                steps.append(acting)
            together = np.stack(steps)
        else:
            together = self.act(commands, np.empty((*commands.shape[:-1], 0)))[0]
        return np.moveaxis(together, 0, inputs.ndim - 2)

    def model(self, model: Model) -> Model:
        """Return the model of the mechanics. If it differs in its draws, sizes are numbers here."""
        return model

    def duration(self, model: Model) -> Size:
        """Return the steps of a model of the mechanics that a step of the system takes."""
        return 1.0

    def within(self, flow: Flow) -> Flow:
        """Return the flow of a step for the flow without this effect."""
        return flow

    def in_run(self, run: int | Rows) -> Effect:
        """Return the effect in one execution, or for rows ``(N,)`` that belong to executions, by their numbers."""
        return self

    def allowed(self, x: Array) -> Array:
        """Return the states ``(..., n)`` that the mechanics end a step in, for those without this effect."""
        return x

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

    def sentence(self, plant: Plant) -> str:
        """Return what it is with its sizes and units: a clause without a full stop."""
        raise NotImplementedError

    def python(self) -> str:
        """Return the Python expression that makes it."""
        fields = [(name, value) for name, value in vars(self).items() if name != "sizes"]
        given = [f"{name}={value:.6g}" if isinstance(value, float) else f"{name}={value!r}" for name, value in fields]
        sizes = f"({', '.join(f'{size:.6g}' for size in self.sizes)}{',' if len(self.sizes) == 1 else ''})"
        text = f"causes.{type(self).__name__}({', '.join([sizes, *given])})"
        return text.replace("Joint(rate", "causes.Joint(rate")

    def repair(self, plant: Plant) -> dict[str, str]:
        """Return the lines that put it into a robot's description, by language: ``mjcf``, ``urdf``; none if empty."""
        return {}


@dataclass(frozen=True)
class Parameter:
    """A size to be learned. Its prior is uniform between its bounds."""

    name: str
    low: float
    high: float
    scale: float  #: a change that matters, for the steps of fits and of chains
    unit: str = ""


@dataclass(frozen=True)
class EffectCandidate(ShortRepr):
    """An effect whose sizes are to be learned."""

    effect: Effect
    parameters: tuple[Parameter, ...] = ()  #: one for each size
    starts: tuple[tuple[float, ...], ...] = ((),)  #: first guesses of all sizes

    def sized(self, sizes: Sequence[Size]) -> EffectCandidate:
        """Return the candidate with an effect of these sizes."""
        return replace(self, effect=self.effect.with_sizes(sizes))


def all_sized(candidates: Iterable[EffectCandidate], sizes: Iterable[Size]) -> tuple[EffectCandidate, ...]:
    """Return candidates with effects of these sizes, one for each parameter of all of them in their order."""
    left = iter(sizes)
    return tuple(each.sized([next(left) for _ in each.parameters]) for each in candidates)


def with_one_more(
    effects: tuple[EffectCandidate, ...],
    candidates: Iterable[EffectCandidate],
    starts: Callable[[EffectCandidate], Iterable[tuple[float, ...]]] = lambda candidate: candidate.starts,
) -> list[tuple[EffectCandidate, ...]]:
    """Return effects with one more of another kind, at each of its first guesses."""
    kinds = [each.effect.kind for each in effects]
    others = (each for each in candidates if each.effect.kind not in kinds)
    return [(*effects, each.sized(start)) for each in others for start in starts(each)]


def of_size(effect: Effect, parameter: Parameter, *starts: float) -> EffectCandidate:
    """Return a candidate with one size."""
    return EffectCandidate(effect, (parameter,), tuple((start,) for start in starts))


def of_ratio(effect: Effect) -> EffectCandidate:
    """Return a candidate whose size is a ratio."""
    return of_size(effect, Parameter(effect.name, 0.1, 10.0, 0.1), 0.95, 1.1)


@dataclass(frozen=True, eq=False)
class Observed(ShortRepr):
    """Recorded transitions, from which candidates have their bounds and first guesses."""

    plant: Plant
    x: Array  #: states ``(N, n)``
    u: Array  #: inputs ``(N, m)``
    missed: Array  #: root mean squares of the residuals of M ``(n,)``
    seconds: float  #: of the longest execution
    estimated: bool  #: whether states are estimated from outputs, so that they have no sensors
    runs: int = 1  #: the number of executions

    @functools.cached_property
    def forces(self) -> tuple[tuple[Joint, float, float], ...]:
        """Where forces may enter, each with the force that makes what M misses of the rate, and with a usual rate."""
        found = []
        rows = slice(None, None, max(1, len(self.x) // 50))
        flow = Flow.of(self.plant.model, self.x[rows], self.u[rows])
        for joint in self.plant.ports:
            probe = 1.0 if joint.input is None or joint.dof is not None else 0.1 * self.plant.commanded[joint.input]
            changes = drive(flow, joint, float(probe), self.plant.dt)[:, joint.rate]
            changes = changes[np.isfinite(changes)]
            size = float(np.sqrt((changes**2).mean())) if len(changes) else 0.0
            speed = float(np.sqrt((self.x[:, joint.rate] ** 2).mean()))
            if size > 0 and speed > 0 and self.missed[joint.rate] > 0:
                found.append((joint, float(self.missed[joint.rate]) / size, speed))
        return tuple(found)


@dataclass(frozen=True)
class OfInput(Effect):
    """An effect in one input. A subclass has the formula of what acts, and the words."""

    input: int = 0
    holds: ClassVar[bool] = False  #: whether what acts depends on what acted before
    words: ClassVar[str]  #: with the ``name`` and ``unit`` of the input and the ``size``; ``play`` is twice the size

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        for k, most in enumerate(observed.plant.commanded.tolist()):
            yield cls.of_input(k, most, observed)

    @classmethod
    def of_input(cls, k: int, most: float, observed: Observed) -> EffectCandidate:
        """Return the candidate of an input, whose largest magnitude is given."""
        size = Parameter(cls.name, 0.0, most, 0.02 * most, observed.plant.inputs[k][1])
        return of_size(cls((0.0,), k), size, *(share * most for share in (0.01, 0.05, 0.15)))

    def remembered(self, inputs: int) -> int:
        return int(self.holds)

    def acts(self, u: Array, before: Array) -> Array:
        """Return what acts ``(...)`` for what is commanded of the input, and what acted before, 0 at first."""
        raise NotImplementedError

    def act(self, u: Array, memory: Array) -> tuple[Array, Array]:
        acting = np.array(u, dtype=np.float64)
        now = self.acts(u[..., self.input], memory[..., 0] if self.holds else u[..., self.input])
        acting[..., self.input] = now
        return acting, now[..., None] if self.holds else memory

    def sentence(self, plant: Plant) -> str:
        (name, unit), (size,) = plant.inputs[self.input], self.sizes or (0.0,)
        return self.words.format(name=name, unit=unit, size=size, play=2 * size).rstrip()


def at_index(values: Array, index: int | list[int] | None, size: Size, elsewhere: float = 0.0) -> Array:
    """Return an array of the last axis of values with a size at some places, or everywhere if the index is None."""
    sizes = np.full((*np.shape(size), values.shape[-1]), elsewhere)
    sizes[..., slice(None) if index is None else np.atleast_1d(index)] = beside(size)
    return sizes


def beside(size: Size, axes: int = 1) -> Array:
    """Return a size with more axes at its end, as a factor of vectors or matrices."""
    return np.reshape(size, (*np.shape(size), *[1] * axes))


def seconds_text(seconds: float) -> str:
    """Return a duration in seconds, or in milliseconds if it is below one."""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def exchanged(values: Array, first: Sequence[int], second: Sequence[int]) -> Array:
    """Return values with some places of the last axis exchanged for others."""
    order = np.arange(values.shape[-1])
    order[[*first, *second]] = [*second, *first]
    return values[..., order]
