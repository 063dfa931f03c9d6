"""A model with effects in it, which is also a system."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Model, paired
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.learning.effects.effect import Effect
from ctxval.learning.effects.flow import Flow, Linearisation


@dataclass(frozen=True, eq=False)
class ModelWithEffects(ShortRepr):
    """A model with effects, which is also a system. Effects of the inputs act in their order, after the controller.

    A step of the model is a function of state and input, so it lacks effects that remember inputs, such as a delay;
    ``complete`` is False then. As a system, it has all effects.
    """

    given: Model
    effects: tuple[Effect, ...]

    batched: ClassVar[bool] = True

    @functools.cached_property
    def mechanics(self) -> Model:
        """M with what effects change in it."""
        return functools.reduce(lambda model, effect: effect.model(model), self.effects, self.given)

    @property
    def complete(self) -> bool:
        """Whether a step has all effects."""
        return not any(effect.remembers for effect in self.effects)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next recorded states ``(..., n)`` of recorded states; effects that remember are left out."""
        if x.ndim != u.ndim:
            x, u = map(np.array, paired(x, u))
        for effect in self.effects:
            u = u if effect.remembers else effect.follow(u, None)[0]
        return self.recorded(self.reached(self.true(x), u))

    def reached(self, x: Array, acting: Array, at: Linearisation | None = None) -> Array:
        """Return the next states ``(..., n)`` for the inputs that act; M may be linearised ``at`` states near x."""
        duration = math.prod(effect.duration(self.mechanics) for effect in self.effects)
        inside = [effect for effect in self.effects if type(effect).within is not Effect.within]
        with np.errstate(all="ignore"):
            while duration > 0:  # whole steps of M, and the rest of one
                if inside or duration < 1 or acting.ndim > x.ndim:
                    flow = Flow.of(self.mechanics, x, acting, at)
                    x = functools.reduce(lambda flow, effect: effect.within(flow), inside, flow).end(min(duration, 1.0))
                else:
                    x = np.asarray(self.mechanics.step(x, acting))
                duration, at = duration - 1, None
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

    def acting(self, inputs: Array) -> Array:
        """Return the inputs that act in each step, for commanded ones ``(..., H, m)``; see :meth:`Effect.follow`."""
        acting = list(np.moveaxis(inputs, -2, 0))
        for effect in self.effects:
            memory = None
            for t, u in enumerate(acting):
                acting[t], memory = effect.follow(u, memory)
        return np.stack(acting, axis=inputs.ndim - 2)

    def execute(self, controller: Controller, task: Task, noise: Array | None = None) -> Trajectory:
        """Return the closed loop with all effects; the controller acts on what is recorded.

        Noise ``(H + 1, ..., n)`` is added to each recorded state; the initial state of the task has it already.
        """
        truth = self.true(np.asarray(task.initial_state, dtype=np.float64) - (0.0 if noise is None else noise[0]))
        memories: list[Any] = [None] * len(self.effects)
        added = iter(() if noise is None else noise[1:])

        def step(_: Array, u: Array) -> Array:
            nonlocal truth
            u = np.array(u)
            for k, effect in enumerate(self.effects):
                u, memories[k] = effect.follow(u, memories[k])
            truth = self.reached(truth, u)
            return self.recorded(truth) + next(added, 0.0)

        for effect in self.effects:
            controller = effect.seeing(controller)
        return rollout(step, controller, task)
