"""Effects in time: commands that act late, actuators that lag, and observations that are old."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import counted
from ctxval.core.controller import Controller, memory_of, stepped
from ctxval.core.task import Task
from ctxval.learning.effects.effect import Effect, seconds_text
from ctxval.learning.effects.flow import PARTS
from ctxval.learning.effects.plant import Plant
from ctxval.systems.actuator import Actuator


@dataclass(frozen=True)
class Late(Effect):
    """All inputs act late. Before the first input, 0 acts."""

    remembers: ClassVar[bool] = True
    held: bool = True  #: whether the mean over a step acts in it, as in :class:`ctxval.systems.Imperfect`

    @property
    def actuator(self) -> Actuator:
        """What the inputs pass."""
        raise NotImplementedError

    @property
    def kind(self) -> Effect:
        return replace(self, sizes=(), held=True)

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        return self.actuator.follow(u, memory, 1 if self.held else PARTS)


@dataclass(frozen=True)
class Delay(Late):
    """All inputs act late. Size: the delay in steps, which need not be an integer."""

    name: ClassVar[str] = "delay"

    @property
    def actuator(self) -> Actuator:
        return Actuator(delay=max(self.sizes[0], 0.0))

    def text(self, plant: Plant) -> str:
        steps = f"{self.sizes[0]:.3g} steps" + ("" if self.held else ", not held over a step")
        return f"commands arrive {seconds_text(plant.dt * self.sizes[0])} late ({steps})"


@dataclass(frozen=True)
class Lag(Late):
    """All inputs are followed by a first-order lag. Size: the time constant in steps."""

    name: ClassVar[str] = "lag"

    @property
    def actuator(self) -> Actuator:
        return Actuator(lag=max(self.sizes[0], 1e-3))

    def text(self, plant: Plant) -> str:
        held = "" if self.held else " while a step goes on"
        return f"the actuators follow{held} with a time constant of {seconds_text(plant.dt * self.sizes[0])}"


@dataclass(frozen=True)
class ObservationDelay(Effect):
    """The controller acts on old records. Their age is counted, and not fitted."""

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "observation delay"
    remembers: ClassVar[bool] = True
    steps: int = 1  #: the age

    def seeing(self, controller: Controller) -> Controller:
        return SeeingLate(controller, self.steps)

    def text(self, plant: Plant) -> str:
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
