"""Joints with another inertia, or at which something else pulls at rest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ctxval.learning.effects.effect import Effect, EffectCandidate, Observed, beside, of_ratio
from ctxval.learning.effects.flow import Flow, times
from ctxval.learning.effects.plant import Joint, Plant, accelerations


def _groups(plant: Plant) -> tuple[tuple[Joint, ...], ...]:
    """Return each joint alone, and all of them together; none of MuJoCo, whose models have attributes for this."""
    if plant.compiled is not None:
        return ()
    return *((joint,) for joint in plant.joints), *([plant.joints] if len(plant.joints) > 1 else [])


@dataclass(frozen=True)
class Inertia(Effect):
    """Joints have another inertia. Size: the inertia divided by that of M."""

    name: ClassVar[str] = "inertia"
    joints: tuple[Joint, ...] = ()  #: those whose accelerations are divided by the size
    dt: float = 1.0  #: seconds

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        for joints in _groups(observed.plant):
            yield of_ratio(cls((1.0,), joints, observed.plant.dt))

    def within(self, flow: Flow) -> Flow:
        n = flow.start.shape[-1]
        divided = np.eye(n) + beside(1.0 / self.sizes[0] - 1.0, 2) * accelerations(n, self.joints, self.dt)
        pushes = tuple((times(divided, drive), rate, force) for drive, rate, force in flow.pushes)
        d, varied = times(divided, flow.d), times(divided, flow.varied)
        return replace(flow, A=divided @ flow.A, d=d, varied=varied, pushes=pushes)

    def sentence(self, plant: Plant) -> str:
        names = " and ".join(map(plant.joint_name, self.joints))
        return f"{names} {'has' if len(self.joints) == 1 else 'have'} {self.sizes[0]:.3g} times the inertia of M"


@dataclass(frozen=True)
class Gravity(Effect):
    """What pulls at joints at rest has another size, such as the weight of links. Size: divided by that of M."""

    name: ClassVar[str] = "gravity"
    joints: tuple[Joint, ...] = ()  #: those that it pulls at
    rates: tuple[int, ...] = ()  #: indices of all states that are 0 at rest
    dt: float = 1.0  #: seconds

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        # The joints have positions, all or none.
        rates = tuple(joint.rate for joint in observed.plant.joints if joint.position is not None)
        for joints in _groups(observed.plant) if rates else ():
            yield of_ratio(cls((1.0,), joints, rates, observed.plant.dt))

    def within(self, flow: Flow) -> Flow:
        resting, n = np.array(flow.start), flow.start.shape[-1]
        resting[..., list(self.rates)] = 0.0
        pulled = flow.driven(np.asarray(flow.model.step(resting, np.zeros_like(flow.inputs))) - resting)
        more = beside(self.sizes[0] - 1.0, 2) * accelerations(n, self.joints, self.dt)
        by_positions = np.delete(np.eye(n), self.rates, axis=0)
        slopes = more @ flow.A @ (by_positions.T @ by_positions)
        return replace(flow, A=flow.A + slopes, d=flow.d + times(more, pulled))

    def sentence(self, plant: Plant) -> str:
        names = " and ".join(map(plant.joint_name, self.joints))
        return f"the weights (or the springs) that pull at {names} are {self.sizes[0]:.3g} times those of M"
