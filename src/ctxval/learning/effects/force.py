"""Forces on joints, which act while a step goes on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import Effect
from ctxval.learning.effects.flow import Flow
from ctxval.learning.effects.plant import Joint, Plant


@dataclass(frozen=True)
class Force(Effect):
    """A force on a joint, in units of its input, of MuJoCo, or of an acceleration, which acts while a step goes on."""

    joint: Joint = Joint(0)  # noqa: RUF009  # where it enters; it is frozen
    probe: float = 1.0  #: a force that is typical of the joint, with which its effect in M is measured
    dt: float = 1.0  #: seconds

    def drive(self, flow: Flow) -> Array:
        """Return the change of the state by one unit of the force in a step of M, in units of ``flow.d``."""
        model, x, u = flow.model, flow.start, flow.inputs
        if self.joint.dof is not None:  # of a model of MuJoCo
            forces = self.probe * np.eye(model.compiled.nv)[self.joint.dof]  # type: ignore[attr-defined]
            pushed = model.changed(forces=forces).step(x, u)  # type: ignore[attr-defined]
            return flow.driven((pushed - flow.reached) / self.probe)
        if self.joint.input is not None:
            moved = u + self.probe * np.eye(u.shape[-1])[self.joint.input]
            return flow.driven((np.asarray(model.step(x, moved)) - flow.reached) / self.probe)
        accelerated = accelerations(x.shape[-1], [self.joint], self.dt)[:, self.joint.rate]
        return np.broadcast_to(self.dt * accelerated, x.shape)

    def force(self, rate: Array, load: Array | float, stopping: Array) -> Array:
        """Return the force ``(...)`` at a rate, a load of the gears, and a force that would stop the joint."""
        raise NotImplementedError

    def load(self, flow: Flow) -> Array | float:
        """Return the magnitude of the force that the gears carry ``(...)`` when a step begins, if it matters."""
        return 0.0

    def within(self, flow: Flow) -> Flow:
        load = self.load(flow)
        push = self.drive(flow), self.joint.rate, lambda rate, stopping: self.force(rate, load, stopping)
        return replace(flow, pushes=(*flow.pushes, push))

    def amount(self, plant: Plant, size: float) -> str:
        return f"{size:.3g} {plant.force_unit(self.joint)}"


def accelerations(n: int, joints: Sequence[Joint], dt: float) -> Array:
    """Return the part ``(n, n)`` of derivatives that accelerations of joints make, as M integrates."""
    part = np.zeros((n, n))
    for joint in joints:
        part[joint.rate, joint.rate] = 1.0
        if joint.position is not None:
            part[joint.position, joint.rate] = (joint.share - 0.5) * dt
    return part
