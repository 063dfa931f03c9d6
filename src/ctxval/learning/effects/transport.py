"""Effects in time: commands that act late, actuators that lag, and observations that are old."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import counted
from ctxval.core.controller import Controller, memory_of, stepped
from ctxval.core.task import Task
from ctxval.learning.effects.effect import Effect, EffectCandidate, Observed, Parameter, Size, of_size, seconds_text
from ctxval.learning.effects.flow import PARTS
from ctxval.learning.effects.plant import Plant
from ctxval.systems.actuator import Actuator


@dataclass(frozen=True)
class Late(Effect):
    """All inputs act late. Before the first input, 0 acts."""

    held: bool = True  #: whether the mean over a step acts in it, as in :class:`ctxval.systems.Imperfect`
    size: ClassVar[Parameter]
    guesses: ClassVar[tuple[float, ...]]

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        for held in (True, False) if observed.plant.compiled is None else (True,):  # parts of steps of MuJoCo cost more
            yield of_size(cls((1.0,), held), cls.size, *cls.guesses)

    @property
    def actuator(self) -> Actuator:
        """What the inputs pass."""
        raise NotImplementedError

    @property
    def kind(self) -> Effect:
        return replace(self, sizes=(), held=True)

    @property
    def in_parts(self) -> bool:
        return not self.held

    def remembered(self, inputs: int) -> int:
        return self.actuator.remembered(inputs) if self.sizes else 0

    def act(self, u: Array, memory: Array) -> tuple[Array, Array]:
        return self.actuator.follow(u, memory, 1 if self.held else PARTS)

    def acting(self, inputs: Array) -> Array:
        return self.actuator.acting(inputs, 1 if self.held else PARTS)


@dataclass(frozen=True)
class Delay(Late):
    """All inputs act late. Size: the delay in steps, which need not be an integer."""

    name: ClassVar[str] = "delay"
    size: ClassVar[Parameter] = Parameter("delay", 0.0, 8.0, 0.2, "steps")
    guesses: ClassVar[tuple[float, ...]] = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)

    @property
    def actuator(self) -> Actuator:
        return Actuator(delay=np.maximum(self.sizes[0], 0.0))

    def sentence(self, plant: Plant) -> str:
        steps = f"{self.sizes[0]:.3g} steps" + ("" if self.held else ", not held over a step")
        return f"commands arrive {seconds_text(plant.dt * float(self.sizes[0]))} late ({steps})"


@dataclass(frozen=True)
class Lag(Late):
    """All inputs are followed by a first-order lag. Size: the time constant in steps."""

    name: ClassVar[str] = "lag"
    size: ClassVar[Parameter] = Parameter("lag", 0.05, 10.0, 0.2, "steps")
    guesses: ClassVar[tuple[float, ...]] = (0.5, 1.5, 4.0)

    @property
    def actuator(self) -> Actuator:
        return Actuator(lag=np.maximum(self.sizes[0], 1e-3))

    def sentence(self, plant: Plant) -> str:
        held = "" if self.held else " while a step goes on"
        return f"the actuators follow{held} with a time constant of {seconds_text(plant.dt * float(self.sizes[0]))}"


@dataclass(frozen=True)
class ObservationDelay(Effect):
    """The controller acts on old records. Their age is counted, and not fitted."""

    sizes: tuple[Size, ...] = ()
    name: ClassVar[str] = "observation delay"
    remembers: ClassVar[bool] = True  # the controller does
    steps: int = 1  #: the age

    def seeing(self, controller: Controller) -> Controller:
        return SeeingLate(controller, self.steps)

    def sentence(self, plant: Plant) -> str:
        age = seconds_text(plant.dt * self.steps)
        return f"the observations that the controller acts on are {counted(self.steps, 'step')} old ({age})"


@dataclass(frozen=True)
class SeeingLate:
    """A controller that sees states some steps late, and the first one before it sees another one."""

    controller: Controller
    steps: int

    def start(self, task: Task) -> Any:
        """Return the memory before the first step."""
        return memory_of(self.controller, task), ()

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        """Return the inputs and the memory after the step."""
        of_controller, before = memory
        known = (*before, np.array(x))[-self.steps - 1 :]
        u, of_controller = stepped(self.controller, t, known[0], of_controller)
        return u, (of_controller, known)
