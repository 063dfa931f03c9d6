"""Actuators that act late: the definition of a delay and of a lag for simulations, learned dynamics and causes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array


@dataclass(frozen=True)
class Actuator:
    """How the inputs act that a controller commands; before the first one, they are 0.

    A step of a system takes one input, so what acts in a step is the mean over it.
    """

    delay: float = 0.0  #: steps by which inputs act late; between whole steps, two inputs act in parts
    #: time constant in steps of the first-order lag with which delayed inputs are followed; 0 if there is none
    lag: float = 0.0

    def follow(self, u: Array, memory: Any = None, parts: int = 1) -> tuple[Array, Any]:
        """Return the inputs that act ``(..., m)`` for those that are commanded, and a memory; None at the first step.

        With parts, they are the means over these parts of the step, ``(..., parts, m)``. The memory has the latest
        commands, the latest first, and what the lag has reached when the step ends.
        """
        whole, late = int(self.delay), parts * (self.delay % 1.0)
        commanded, reached = ((), np.zeros_like(u)) if memory is None else memory
        commanded = (u, *commanded)[: whole + 2]
        newer, older = ((*commanded, *[np.zeros_like(u)] * (whole + 2))[whole + k] for k in (0, 1))
        weights = np.clip(np.arange(1, parts + 1) - late, 0.0, 1.0) if late else np.ones(parts)
        weights = weights.reshape(-1, *[1] * np.ndim(u))
        acting = weights * newer + (1 - weights) * older
        for part in acting if self.lag else ():
            part[...], reached = self._followed(reached, part, parts)
        return acting[0] if parts == 1 else np.moveaxis(acting, 0, -2), (commanded, reached)

    def acting(self, inputs: Array) -> Array:
        """Return the inputs that act in each step, for commanded ones ``(..., H, m)``."""
        H, due = inputs.shape[-2], np.zeros_like(inputs)
        whole, share = int(self.delay), self.delay % 1.0
        for weight, back in ((1.0 - share, whole), (share, whole + 1)):
            due[..., back:, :] += weight * inputs[..., : max(H - back, 0), :]
        reached = np.zeros_like(due[..., 0, :])
        for t in range(H) if self.lag else ():
            due[..., t, :], reached = self._followed(reached, due[..., t, :])
        return due

    def _followed(self, reached: Array, due: Array, parts: int = 1) -> tuple[Array, Array]:
        """Return the mean over a part of a step of what approaches the inputs that are due, and what it reaches."""
        lag, missing = parts * self.lag, reached - due
        gone = math.exp(-1 / lag)
        return due + missing * (lag * (1 - gone)), due + missing * gone
