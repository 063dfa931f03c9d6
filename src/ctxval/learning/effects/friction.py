"""Friction of joints: viscous, Coulomb, at rest, Stribeck and load-dependent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import scipy

from ctxval._util.arrays import Array, rows_of
from ctxval.learning.effects.effect import EffectCandidate, Observed, Parameter, beside, of_size
from ctxval.learning.effects.flow import Flow, times
from ctxval.learning.effects.force import Force, force_parameter, limited
from ctxval.learning.effects.plant import Joint, Plant

Where = tuple[Joint, float, float]


def slowness(before: Array, after: Array, slow: Any) -> Array:
    """Return the mean of ``exp(-(rate / slow)^2)`` over steps in which rates change evenly; all shapes ``(..., m)``."""
    first, last = before / slow, after / slow
    same = np.abs(last - first) < 1e-4
    mean = scipy.special.erf(last) - scipy.special.erf(first)
    mean = 0.5 * np.sqrt(np.pi) * mean / np.where(same, 1.0, last - first)
    return np.asarray(np.where(same, np.exp(-(first**2)), mean))


@dataclass(frozen=True)
class Viscous(Force):
    """Friction in proportion to the rate. Size: the coefficient; negative if M has too much of it."""

    name: ClassVar[str] = "viscous friction"

    @classmethod
    def on_joint(cls, observed: Observed, where: Where, force: float, speed: float) -> Iterator[EffectCandidate]:
        if where[0].dof is None:  # otherwise it is an attribute of the joint
            slope, joint = force / speed, where[0]
            rate = observed.plant.rate_unit(joint)
            unit = observed.plant.force_unit(joint) + (f" per {rate}" if rate else "")
            yield of_size(cls((0.0,), *where), Parameter(cls.name, -20 * slope, 20 * slope, 0.1 * slope, unit), 0.0)

    def within(self, flow: Flow) -> Flow:
        drive, rate = beside(self.sizes[0]) * self.drive(flow), self.joint.rate
        A = np.array(np.broadcast_to(flow.A, (*drive.shape, drive.shape[-1])))
        A[..., rate] -= drive
        return replace(flow, A=A, d=flow.d - drive * flow.start[..., rate, None])

    def sentence(self, plant: Plant) -> str:
        rate, more = plant.rate_unit(self.joint), "more" if self.sizes[0] >= 0 else "less"
        size = self.amount(plant, abs(self.sizes[0])) + (f" per {rate}" if rate else "")
        return f"{plant.joint_name(self.joint)} has {more} viscous friction than M ({size})"


@dataclass(frozen=True)
class Coulomb(Force):
    """Friction whose magnitude does not depend on the rate; at rest it holds. Size: the magnitude."""

    name: ClassVar[str] = "Coulomb friction"

    @classmethod
    def on_joint(cls, observed: Observed, where: Where, force: float, speed: float) -> Iterator[EffectCandidate]:
        if where[0].dof is None:
            size = force_parameter(observed, where[0], cls.name, force)
            yield of_size(cls((0.0,), *where), size, 0.3 * force, force)

    def force(self, before: Array, rate: Array, load: Array | float, stopping: Array) -> Array:
        return limited(stopping, self.sizes[0])

    def sentence(self, plant: Plant) -> str:
        return f"{plant.joint_name(self.joint)} sticks ({self.amount(plant, self.sizes[0])})"


@dataclass(frozen=True)
class DirectedFriction(Force):
    """Coulomb friction that differs with the direction. Sizes: the magnitudes at positive and at negative rates."""

    name: ClassVar[str] = "friction by direction"

    @classmethod
    def on_joint(cls, observed: Observed, where: Where, force: float, speed: float) -> Iterator[EffectCandidate]:
        sizes = tuple(force_parameter(observed, where[0], name, force) for name in ("forwards", "backwards"))
        yield EffectCandidate(cls((0.0, 0.0), *where), sizes, ((force, 0.3 * force), (0.3 * force, force)))

    def force(self, before: Array, rate: Array, load: Array | float, stopping: Array) -> Array:
        forwards, backwards = self.sizes
        return limited(stopping, np.where(2 * rate > before, forwards, backwards))

    def sentence(self, plant: Plant) -> str:
        forwards, backwards = (self.amount(plant, size) for size in self.sizes)
        return f"the friction of {plant.joint_name(self.joint)} is {forwards} forwards and {backwards} backwards"


@dataclass(frozen=True)
class FrictionAtRest(Force):
    """Coulomb friction that is larger at rest alone. Sizes: in motion, and what is added at rest.

    A joint leaves rest if more acts on it than both together (Karnopp, "Computer simulation of stick-slip friction in
    mechanical dynamic systems", ASME Journal of Dynamic Systems, Measurement, and Control 107, 1985).
    """

    name: ClassVar[str] = "friction at rest"
    still: float = 0.0  #: the largest rate of a joint at rest

    @classmethod
    def on_joint(cls, observed: Observed, where: Where, force: float, speed: float) -> Iterator[EffectCandidate]:
        sliding, added = (force_parameter(observed, where[0], name, force) for name in ("sliding", "added at rest"))
        starts = ((0.5 * force, 0.3 * force), (0.3 * force, force))
        yield EffectCandidate(cls((0.0, 0.0), *where, 1e-3 * speed), (sliding, added), starts)

    def force(self, before: Array, rate: Array, load: Array | float, stopping: Array) -> Array:
        sliding, added = self.sizes
        return limited(stopping, sliding + np.where(np.abs(before) <= self.still, added, 0.0))

    def sentence(self, plant: Plant) -> str:
        sliding, added = (self.amount(plant, size) for size in (self.sizes[0], sum(self.sizes)))
        return f"{plant.joint_name(self.joint)} sticks more at rest ({added}) than in motion ({sliding})"


@dataclass(frozen=True)
class Stribeck(Force):
    """Coulomb friction that is larger at low rates. Sizes: at high rates, what is added at rest, and the rate.

    Armstrong-Helouvry, Dupont and Canudas de Wit, "A survey of models, analysis tools and compensation methods for the
    control of machines with friction", Automatica 30 (1994).
    """

    name: ClassVar[str] = "Stribeck friction"

    @classmethod
    def on_joint(cls, observed: Observed, where: Where, force: float, speed: float) -> Iterator[EffectCandidate]:
        sliding, added = (force_parameter(observed, where[0], name, force) for name in ("sliding", "added at rest"))
        slow = Parameter("slow rate", 0.01 * speed, 2 * speed, 0.1 * speed, observed.plant.rate_unit(where[0]))
        starts = ((0.5 * force, 0.5 * force, 0.3 * speed), (0.7 * force, 0.3 * force, 0.1 * speed))
        yield EffectCandidate(cls((0.0, 0.0, 1.0), *where), (sliding, added, slow), starts)

    def force(self, before: Array, rate: Array, load: Array | float, stopping: Array) -> Array:
        sliding, added, slow = self.sizes
        return limited(stopping, sliding + added * slowness(before, 2 * rate - before, np.maximum(slow, 1e-12)))

    def sentence(self, plant: Plant) -> str:
        sliding, added, slow = self.sizes
        name, rate = plant.joint_name(self.joint), plant.rate_unit(self.joint)
        sizes = f"{self.amount(plant, sliding + added)} at rest, {self.amount(plant, sliding)} above {slow:.3g} {rate}"
        return f"{name} sticks more at low rates ({sizes.rstrip()})"


@dataclass(frozen=True)
class LoadFriction(Force):
    """Friction in proportion to the load that the gears carry. Sizes: the share of the load, and the part without it.

    The load is the difference between the force of the motor and what everything else pulls with, as M has it.
    """

    name: ClassVar[str] = "load-dependent friction"
    rates: tuple[int, ...] = ()  #: the rates of all joints that inputs drive

    @classmethod
    def on_joint(cls, observed: Observed, where: Where, force: float, speed: float) -> Iterator[EffectCandidate]:
        rates = tuple(dict.fromkeys(port.rate for port in observed.plant.ports if port.input is not None))
        share = Parameter("share of the load", 0.0, 2.0, 0.05)
        sizes = share, force_parameter(observed, where[0], "without load", force)
        yield EffectCandidate(cls((0.0, 0.0), *where, rates), sizes, ((0.05, 0.0), (0.2, 0.3 * force)))

    def load(self, flow: Flow) -> Array:
        model, x, u = flow.model, flow.start, flow.inputs
        if self.joint.dof is not None:  # the force of the actuators minus what pulls, by the dynamics of MuJoCo
            import mujoco

            compiled: Any = model.compiled  # type: ignore[attr-defined]
            states, inputs, nq = rows_of(x), rows_of(u), compiled.nq
            data, pulls = mujoco.MjData(compiled), np.full(len(states), np.nan)
            for k in np.flatnonzero(np.isfinite(states).all(axis=1)):
                data.qpos, data.qvel, data.ctrl = states[k, :nq], states[k, nq:], inputs[k]
                mujoco.mj_forward(compiled, data)
                pulls[k] = (data.qfrc_actuator + data.qfrc_bias)[self.joint.dof]
            return np.asarray(np.abs(pulls).reshape(x.shape[:-1]))
        resting, m = np.asarray(model.step(x, np.zeros_like(u))), u.shape[-1]
        pulled = flow.driven(resting - x)
        if self.joint.input is None:
            return np.asarray(np.abs(flow.d - 2 * pulled)[..., self.joint.rate] / self.dt)
        # What pulls is as large as the motors' forces that would do the same: each of them moves all joints.
        rates, probes = list(self.rates), self.probe * np.eye(m)
        moved = (np.asarray(model.step(x, np.zeros_like(u) + each)) for each in probes)
        effects = np.stack([flow.driven(each - resting)[..., rates] / self.probe for each in moved], axis=-1)
        effects = np.nan_to_num(effects, nan=0.0, posinf=0.0, neginf=0.0)  # a step of M may have failed
        pulls = u - times(np.asarray(np.linalg.pinv(effects), dtype=np.float64), pulled[..., rates])
        return np.asarray(np.abs(pulls[..., self.joint.input]))

    def force(self, before: Array, rate: Array, load: Array | float, stopping: Array) -> Array:
        return limited(stopping, self.sizes[0] * load + self.sizes[1])

    def sentence(self, plant: Plant) -> str:
        more = f", and {self.amount(plant, self.sizes[1])}" if self.sizes[1] > 1e-3 * self.probe else ""
        name = plant.joint_name(self.joint)
        return f"the friction of {name} depends on the load ({100 * self.sizes[0]:.3g} % of it{more})"
