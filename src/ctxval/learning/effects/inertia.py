"""Joints with another inertia."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ctxval.learning.effects.effect import Effect
from ctxval.learning.effects.flow import Flow
from ctxval.learning.effects.force import accelerations
from ctxval.learning.effects.plant import Joint, Plant


@dataclass(frozen=True)
class Inertia(Effect):
    """Joints have another inertia. Size: the inertia divided by that of M."""

    name: ClassVar[str] = "inertia"
    joints: tuple[Joint, ...] = ()  #: those whose accelerations are divided by the size
    dt: float = 1.0  #: seconds

    def within(self, flow: Flow) -> Flow:
        n = flow.start.shape[-1]
        divided = np.eye(n) + (1.0 / self.sizes[0] - 1.0) * accelerations(n, self.joints, self.dt)
        pushes = tuple((drive @ divided.T, rate, force) for drive, rate, force in flow.pushes)
        return replace(flow, A=divided @ flow.A, d=flow.d @ divided.T, varied=flow.varied @ divided.T, pushes=pushes)

    def text(self, plant: Plant) -> str:
        names = " and ".join(map(plant.joint_name, self.joints))
        return f"{names} {'has' if len(self.joints) == 1 else 'have'} {self.sizes[0]:.3g} times the inertia of M"
