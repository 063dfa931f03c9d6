"""Forces on joints, which act while a step goes on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import Effect, EffectCandidate, Observed, Parameter
from ctxval.learning.effects.flow import Flow
from ctxval.learning.effects.plant import Joint, Plant, drive


@dataclass(frozen=True)
class Force(Effect):
    """A force on a joint, in units of its input, of MuJoCo, or of an acceleration, which acts while a step goes on."""

    joint: Joint = Joint(0)  # noqa: RUF009  # where it enters; it is frozen
    probe: float = 1.0  #: a force that is typical of the joint, with which its effect in M is measured
    dt: float = 1.0  #: seconds

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        for joint, force, speed in observed.forces:
            yield from cls.on_joint(observed, (joint, 0.1 * force, observed.plant.dt), force, speed)

    @classmethod
    def on_joint(
        cls, observed: Observed, where: tuple[Joint, float, float], force: float, speed: float
    ) -> Iterator[EffectCandidate]:
        """Yield the candidates at a joint for a typical force and rate; ``where`` are the fields after the sizes."""
        raise NotImplementedError

    def drive(self, flow: Flow) -> Array:
        """Return the change of the state by one unit of the force in a step of M, in units of ``flow.d``."""
        return drive(flow, self.joint, self.probe, self.dt)

    def force(self, before: Array, rate: Array, load: Array | float, stopping: Array) -> Array:
        """Return the force ``(...)`` in a part of a step, which would let the joint stop if it were ``stopping``.

        The arguments are the rate before the part, its mean if no force acted, and the load of the gears.
        """
        raise NotImplementedError

    def load(self, flow: Flow) -> Array | float:
        """Return the magnitude of the force that the gears carry ``(...)`` when a step begins, if it matters."""
        return 0.0

    def within(self, flow: Flow) -> Flow:
        load = self.load(flow)

        def force(before: Array, rate: Array, stopping: Array) -> Array:
            return self.force(before, rate, load, stopping)

        return replace(flow, pushes=(*flow.pushes, (self.drive(flow), self.joint.rate, force)))

    def amount(self, plant: Plant, size: Any) -> str:
        """Return a force with its unit."""
        return f"{size:.3g} {plant.force_unit(self.joint)}"


def force_parameter(observed: Observed, joint: Joint, name: str, force: float, *, both: bool = False) -> Parameter:
    """Return the parameter of a force on a joint, which may have ``both`` signs, for a typical one."""
    return Parameter(name, -20 * force if both else 0.0, 20 * force, 0.1 * force, observed.plant.force_unit(joint))


def limited(stopping: Array, most: Any) -> Array:
    """Return the force of friction that stops a joint if it can, ``(...)``."""
    return np.clip(stopping, -most, most)
