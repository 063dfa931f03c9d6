"""A model with effects in it, which is also a system."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Model, advanced, memory_in, paired
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError
from ctxval.learning.draws import Draws
from ctxval.learning.effects.effect import Effect, beside
from ctxval.learning.effects.flow import Flow, Linearisation
from ctxval.learning.effects.inputs import InputEffects
from ctxval.models import MuJoCo


@dataclass(frozen=True, eq=False)
class ModelWithEffects(ShortRepr):
    """A model with effects, which is also a model with memory and a system.

    Effects of the inputs act in their order, after the controller; those that act in parts of a step are the last ones.
    A step of a state and an input lacks effects that remember, such as a delay; ``complete`` is False then. If sizes
    are arrays, the draws are the first axis of states ``(S, q, n)`` and inputs ``(S, q, m)``.
    """

    given: Model
    effects: tuple[Effect, ...]
    inputs: int = 0  #: number of inputs; it must be given for ``start`` if an effect remembers

    batched: ClassVar[bool] = True

    @functools.cached_property
    def mechanics(self) -> Model:
        """M with what effects change in it."""
        return functools.reduce(lambda model, effect: effect.model(model), self.effects, self.given)

    @property
    def complete(self) -> bool:
        """Whether a step has all effects."""
        return not any(effect.remembers for effect in self.effects)

    @functools.cached_property
    def draws(self) -> int:
        """The number of draws; 0 if all sizes are numbers."""
        sizes = (size for each in self.effects for size in each.sizes if isinstance(size, np.ndarray))
        return max(map(len, sizes), default=0)

    def __getitem__(self, rows: Rows) -> ModelWithEffects:
        """Return some draws."""
        sizes = ([size[rows] if isinstance(size, np.ndarray) else size for size in each.sizes] for each in self.effects)
        few = tuple(each.with_sizes(some) for each, some in zip(self.effects, sizes, strict=True))
        return replace(self, given=self.given[rows] if isinstance(self.given, Draws) else self.given, effects=few)

    def in_run(self, run: int | Rows) -> ModelWithEffects:
        """Return the model in one execution, or for rows that belong to executions; see :meth:`Effect.in_run`."""
        if all(type(each).in_run is Effect.in_run for each in self.effects):
            return self
        return replace(self, effects=tuple(each.in_run(run) for each in self.effects))

    @functools.cached_property
    def _one_by_one(self) -> tuple[ModelWithEffects, ...]:
        """The draws, with numbers as sizes, if they have models of MuJoCo of their own; empty otherwise."""
        changing = [size for each in self.effects if type(each).model is not Effect.model for size in each.sizes]
        if not isinstance(self.given, MuJoCo) or not any(isinstance(size, np.ndarray) for size in changing):
            return ()

        def alone(effect: Effect, k: int) -> Effect:
            return effect.with_sizes([size[k, 0] if isinstance(size, np.ndarray) else size for size in effect.sizes])

        return tuple(replace(self, effects=tuple(alone(each, k) for each in self.effects)) for k in range(self.draws))

    @functools.cached_property
    def _inside(self) -> list[Effect]:
        return [effect for effect in self.effects if type(effect).within is not Effect.within]

    @functools.cached_property
    def _at_ends(self) -> list[Effect]:
        return [effect for effect in self.effects if type(effect).allowed is not Effect.allowed]

    @functools.cached_property
    def of_inputs(self) -> InputEffects:
        """The effects of inputs."""
        acting = [effect for effect in self.effects if type(effect).act is not Effect.act]
        return InputEffects(tuple(sorted(acting, key=lambda effect: effect.in_parts)))

    def start(self, x: Array) -> Array:
        """Return the memory ``(..., k)`` of closed loops that start in recorded states ``(..., n)``."""
        if self.of_inputs.remembered(1) and not self.inputs:
            raise InputError(
                "a model whose effects remember inputs needs their number: ModelWithEffects(..., inputs=m)."
            )
        return self._begun(self.true(x), self.inputs)

    def _begun(self, x: Array, inputs: int) -> Array:
        if self._one_by_one:
            of_model = np.stack([memory_in(each.mechanics, few) for each, few in zip(self._one_by_one, x, strict=True)])
        else:
            of_model = memory_in(self.mechanics, x)
        return np.concatenate([np.zeros((*x.shape[:-1], self.of_inputs.remembered(inputs))), of_model], axis=-1)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next recorded states ``(..., n)`` and the new memory, with all effects."""
        following, memory = self._advanced(self.true(x), u, memory)
        return self.recorded(following), memory

    def _advanced(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        k = self.of_inputs.remembered(u.shape[-1])
        acting, kept = self.of_inputs.act(u, memory[..., :k])
        following, of_model = self._following(x, acting, memory[..., k:])
        return following, np.concatenate([kept, of_model], axis=-1)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next recorded states ``(..., n)`` of recorded states; effects that remember are left out."""
        if x.ndim != u.ndim:
            x, u = map(np.array, paired(x, u))
        nothing = np.empty((*x.shape[:-1], 0))
        for effect in self.of_inputs.effects:
            u = u if effect.remembers else effect.act(u, nothing)[0]
        return self.recorded(self._following(self.true(x), u, nothing)[0])

    def acting(self, inputs: Array) -> Array:
        """Return the inputs that act in each step; see :meth:`InputEffects.acting`."""
        return self.of_inputs.acting(inputs)

    def _following(self, x: Array, acting: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states for the inputs that act, and the memory of M; without it, M begins anew."""
        if self._one_by_one:
            draws = zip(self._one_by_one, x, acting, memory, strict=True)
            both = zip(*(each._following(*few) for each, *few in draws), strict=True)
            states, memories = map(np.stack, both)
            return states, memories
        if not memory.shape[-1]:
            return self.reached(x, acting), memory
        mean = acting.mean(axis=-2) if acting.ndim > x.ndim else acting
        following, memory = advanced(self.mechanics, x, mean, memory)
        if self._inside or self._at_ends or acting.ndim > x.ndim:  # effects change steps, whatever M remembers
            following = following + self.reached(x, acting) - self.mechanics.step(x, mean)
        return following, memory

    def reached(self, x: Array, acting: Array, at: Linearisation | None = None) -> Array:
        """Return the next states ``(..., n)`` for the inputs that act; M may be linearised ``at`` states near x."""
        duration = math.prod(effect.duration(self.mechanics) for effect in self.effects)
        with np.errstate(all="ignore"):
            for k in range(math.ceil(np.max(duration))):  # whole steps of M, and the rest of one
                part = np.clip(duration - k, 0.0, 1.0)
                if self._inside or np.any(part < 1) or acting.ndim > x.ndim:
                    flow = Flow.of(self.mechanics, x, acting, at)
                    x = functools.reduce(lambda flow, effect: effect.within(flow), self._inside, flow).end(part)
                else:
                    x = np.asarray(self.mechanics.step(x, acting))
                if self._at_ends:
                    ended = functools.reduce(lambda x, effect: effect.allowed(x), self._at_ends, x)
                    x = np.where(beside(part) > 0, ended, x)
                at = None
        return x

    def true(self, recorded: Array) -> Array:
        """Return the states ``(..., n)`` of which these are recorded."""
        for effect in reversed(self.effects):
            recorded = effect.true(recorded)
        return recorded

    def recorded(self, x: Array) -> Array:
        """Return what is recorded of states ``(..., n)``."""
        for effect in self.effects:
            x = effect.recorded(x)
        return x

    def execute(self, controller: Controller, task: Task, noise: Array | None = None) -> Trajectory:
        """Return the closed loop with all effects; the controller acts on what is recorded.

        Noise ``(H + 1, ..., n)`` is added to each recorded state; the initial state of the task has it already.
        """
        truth = self.true(np.asarray(task.initial_state, dtype=np.float64) - (0.0 if noise is None else noise[0]))
        memory, added = None, iter(() if noise is None else noise[1:])

        def step(_: Array, u: Array) -> Array:
            nonlocal truth, memory
            u = np.array(u)
            memory = self._begun(truth, u.shape[-1]) if memory is None else memory
            truth, memory = self._advanced(truth, u, memory)
            return self.recorded(truth) + next(added, 0.0)

        for effect in self.effects:
            controller = effect.seeing(controller)
        return rollout(step, controller, task)
