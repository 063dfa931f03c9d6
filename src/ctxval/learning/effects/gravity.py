"""Joints at which something else pulls at rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ctxval.learning.effects.effect import Effect
from ctxval.learning.effects.flow import Flow
from ctxval.learning.effects.force import accelerations
from ctxval.learning.effects.plant import Joint, Plant


@dataclass(frozen=True)
class Gravity(Effect):
    """What pulls at joints at rest has another size, such as the weight of links. Size: divided by that of M."""

    name: ClassVar[str] = "gravity"
    joints: tuple[Joint, ...] = ()  #: those that it pulls at
    rates: tuple[int, ...] = ()  #: indices of all states that are 0 at rest
    dt: float = 1.0  #: seconds

    def within(self, flow: Flow) -> Flow:
        resting, n = np.array(flow.start), flow.start.shape[-1]
        resting[..., list(self.rates)] = 0.0
        pulled = flow.driven(np.asarray(flow.model.step(resting, np.zeros_like(flow.inputs))) - resting)
        more = (self.sizes[0] - 1.0) * accelerations(n, self.joints, self.dt)
        by_positions = np.delete(np.eye(n), self.rates, axis=0)
        slopes = more @ flow.A @ (by_positions.T @ by_positions)
        return replace(flow, A=flow.A + slopes, d=flow.d + pulled @ more.T)

    def text(self, plant: Plant) -> str:
        names = " and ".join(map(plant.joint_name, self.joints))
        return f"the weights (or the springs) that pull at {names} are {self.sizes[0]:.3g} times those of M"
