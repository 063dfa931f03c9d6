"""What a cause of a model's error is, and a model with causes in it.

A robot is its sensors around its mechanics around its actuators. A cause changes one of the three: the inputs that act
for those that are commanded, the next state, or what is recorded of a state.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.studies.causes.plant import Plant


@dataclass(frozen=True)
class Cause(ShortRepr):
    """Something that a model lacks, with its sizes in physical units.

    A subclass changes one of the hooks below. All of them take batches.
    """

    sizes: tuple[float, ...]
    name: ClassVar[str]  #: what it is in two or three words
    #: whether the inputs that act depend on earlier ones, so that it cannot be a part of a step
    remembers: ClassVar[bool] = False

    def with_sizes(self, sizes: Sequence[float]) -> Cause:
        """Return the cause with other sizes."""
        return replace(self, sizes=tuple(float(size) for size in sizes))

    def model(self, model: Model) -> Model:
        """Return the model of the mechanics."""
        return model

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        """Return the inputs that act ``(..., m)`` for those of the causes before, and what is remembered of them.

        The memory is None at the first step.
        """
        return u, memory

    def pushed(self, model: Model, x: Array, u: Array, free: Array, reached: Array) -> Array:
        """Return the next state ``(..., n)`` for that of the model, ``free``, and that without this cause."""
        return reached

    def true(self, recorded: Array) -> Array:
        """Return the states ``(..., n)`` of which these are recorded."""
        return recorded

    def recorded(self, x: Array) -> Array:
        """Return what is recorded of states ``(..., n)``."""
        return x

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


@dataclass(frozen=True, eq=False)
class Repaired(ShortRepr):
    """A model with causes in it.

    It is a model and a system. As a system, it has all causes. A step of the model is a function of state and input, so
    it lacks causes that remember inputs, such as a delay; ``complete`` is False then.

    Causes of the inputs act in the given order, after the controller.
    """

    given: Model
    causes: tuple[Cause, ...]

    batched: ClassVar[bool] = True

    @functools.cached_property
    def mechanics(self) -> Model:
        """M with what causes change in it."""
        model = self.given
        for cause in self.causes:
            model = cause.model(model)
        return model

    @property
    def complete(self) -> bool:
        """Whether a step has all causes."""
        return not any(cause.remembers for cause in self.causes)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next recorded states ``(..., n)`` of recorded states; causes that remember are left out."""
        for cause in self.causes:
            u = u if cause.remembers else cause.follow(u, None)[0]
        return self.recorded(self.reached(self.true(x), u))

    def reached(self, x: Array, acting: Array) -> Array:
        """Return the next states ``(..., n)`` for the inputs that act."""
        with np.errstate(all="ignore"):
            reached = free = np.asarray(self.mechanics.step(x, acting))
            for cause in self.causes:
                reached = cause.pushed(self.mechanics, x, acting, free, reached)
        return reached

    def true(self, recorded: Array) -> Array:
        """Return the states ``(..., n)`` of which these are recorded."""
        for cause in reversed(self.causes):
            recorded = cause.true(recorded)
        return recorded

    def recorded(self, x: Array) -> Array:
        """Return what is recorded of states ``(..., n)``."""
        for cause in self.causes:
            x = cause.recorded(x)
        return x

    def acting(self, inputs: Array) -> Array:
        """Return the inputs that act in each step, for commanded ones ``(..., H, m)``."""
        for cause in self.causes:
            if cause.remembers:
                memory, commanded, inputs = None, inputs, np.empty_like(inputs)
                for t in range(inputs.shape[-2]):
                    inputs[..., t, :], memory = cause.follow(commanded[..., t, :], memory)
            else:
                inputs, _ = cause.follow(inputs, None)
        return inputs

    def execute(self, controller: Controller, task: Task, noise: Array | None = None) -> Trajectory:
        """Return the closed loop with all causes; the controller acts on what is recorded.

        Args:
            noise: what is added to each recorded state, ``(H + 1, ..., n)``; that of the initial state has it already.
        """
        truth = self.true(np.asarray(task.initial_state, dtype=np.float64) - (0.0 if noise is None else noise[0]))
        memories: list[Any] = [None] * len(self.causes)
        added = iter(() if noise is None else noise[1:])

        def step(_: Array, u: Array) -> Array:
            nonlocal truth
            u = np.array(u)
            for k, cause in enumerate(self.causes):
                u, memories[k] = cause.follow(u, memories[k])
            truth = self.reached(truth, u)
            return self.recorded(truth) + next(added, 0.0)

        return rollout(step, controller, task)
