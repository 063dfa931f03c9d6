"""Causes in the mechanics: forces that M lacks, and inertia, gravity or a time step that differ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.model import Model
from ctxval.models import MuJoCo
from ctxval.studies.causes.cause import Cause
from ctxval.studies.causes.plant import Joint, Plant


@dataclass(frozen=True)
class Force(Cause):
    """A force on a joint, in units of its input, of MuJoCo, or of an acceleration; held over a step.

    Attributes:
        joint: where it enters.
        probe: a force that is typical of the joint, with which its effect in M is measured.
        dt: seconds.
    """

    joint: Joint = Joint(0)  # noqa: RUF009  # it is frozen
    probe: float = 1.0
    dt: float = 1.0

    def effect(self, model: Model, x: Array, u: Array, free: Array) -> Array:
        """Return the change of the next state ``free`` of the model by one unit of the force, shape ``(..., n)``."""
        if self.joint.dof is not None:
            assert isinstance(model, MuJoCo)
            forces = np.zeros(model.compiled.nv)
            forces[self.joint.dof] = self.probe
            return (model.changed(forces=forces).step(x, u) - free) / self.probe
        if self.joint.input is not None:
            moved = np.array(u)
            moved[..., self.joint.input] += self.probe
            return (np.asarray(model.step(x, moved)) - free) / self.probe
        effect = np.zeros_like(x)
        effect[..., self.joint.rate] = self.dt
        if self.joint.position is not None:
            effect[..., self.joint.position] = self.joint.share * self.dt**2
        return effect

    def force(self, rate: Array, load: Callable[[], Array], stopping: Array) -> Array:
        """Return the force ``(...)`` at a mean rate; the force ``stopping`` would stop the joint within the step.

        Args:
            load: returns the magnitude of the force that the gears carry.
        """
        raise NotImplementedError

    def pushed(self, model: Model, x: Array, u: Array, free: Array, reached: Array) -> Array:
        effect, number = self.effect(model, x, u, free), self.joint.rate
        moving = np.where(np.abs(effect[..., number]) > 1e-12, effect[..., number], 1e-12)

        def load() -> Array:
            # What the inputs do to the joint, against what everything else does to it, as the model has it.
            unmoved = np.asarray(model.step(x, np.zeros_like(u)))[..., number]
            return np.asarray(np.abs(free[..., number] - 2 * unmoved + x[..., number]) / np.abs(moving))

        rate = 0.5 * (x[..., number] + reached[..., number])
        return reached + effect * self.force(rate, load, -reached[..., number] / moving)[..., None]

    def amount(self, plant: Plant, size: float, per: str = "") -> str:
        return f"{size:.3g} {plant.force_unit(self.joint)}{per}"


@dataclass(frozen=True)
class Bias(Force):
    """A constant force. Size: the force."""

    name: ClassVar[str] = "bias"

    def force(self, rate: Array, load: Callable[[], Array], stopping: Array) -> Array:
        return np.full_like(stopping, self.sizes[0])

    def text(self, plant: Plant) -> str:
        return f"{plant.joint_name(self.joint)} is pushed by a constant {self.amount(plant, self.sizes[0])}"


@dataclass(frozen=True)
class Viscous(Force):
    """Friction in proportion to the rate. Size: the coefficient; negative if M has too much of it."""

    name: ClassVar[str] = "viscous friction"

    def force(self, rate: Array, load: Callable[[], Array], stopping: Array) -> Array:
        return -self.sizes[0] * rate

    def text(self, plant: Plant) -> str:
        rate = plant.rate_unit(self.joint)
        more = "more" if self.sizes[0] >= 0 else "less"
        size = self.amount(plant, abs(self.sizes[0]), f" per {rate}" if rate else "")
        return f"{plant.joint_name(self.joint)} has {more} viscous friction than M ({size})"

    def mjcf(self, plant: Plant) -> str | None:
        return _of_dof(plant, self.joint, "damping", "dof_damping", self.sizes[0])


@dataclass(frozen=True)
class Coulomb(Force):
    """Friction whose magnitude does not depend on the rate; at rest it holds. Size: the magnitude."""

    name: ClassVar[str] = "Coulomb friction"

    def force(self, rate: Array, load: Callable[[], Array], stopping: Array) -> Array:
        return np.clip(stopping, -self.sizes[0], self.sizes[0])

    def text(self, plant: Plant) -> str:
        return f"{plant.joint_name(self.joint)} sticks ({self.amount(plant, self.sizes[0])})"

    def mjcf(self, plant: Plant) -> str | None:
        return _of_dof(plant, self.joint, "frictionloss", "dof_frictionloss", self.sizes[0])


@dataclass(frozen=True)
class Stribeck(Force):
    """Coulomb friction that is larger at low rates. Sizes: at high rates, what is added at rest, and the rate.

    Armstrong-Helouvry, Dupont and Canudas de Wit, "A survey of models, analysis tools and compensation methods for the
    control of machines with friction", Automatica 30 (1994).
    """

    name: ClassVar[str] = "Stribeck friction"

    def force(self, rate: Array, load: Callable[[], Array], stopping: Array) -> Array:
        sliding, added, slow = self.sizes
        most = sliding + added * np.exp(-((rate / max(slow, 1e-12)) ** 2))
        return np.clip(stopping, -most, most)

    def text(self, plant: Plant) -> str:
        sliding, added, slow = self.sizes
        name, rate = plant.joint_name(self.joint), plant.rate_unit(self.joint)
        sizes = f"{self.amount(plant, sliding + added)} at rest, {self.amount(plant, sliding)} above {slow:.3g} {rate}"
        return f"{name} sticks more at low rates ({sizes.rstrip()})"


@dataclass(frozen=True)
class LoadFriction(Force):
    """Friction in proportion to the load that the gears carry. Sizes: the share of the load, and the part without it.

    The load is the difference between what the inputs do to the joint and what everything else does, as M has it.
    """

    name: ClassVar[str] = "load-dependent friction"

    def force(self, rate: Array, load: Callable[[], Array], stopping: Array) -> Array:
        most = self.sizes[0] * load() + self.sizes[1]
        return np.clip(stopping, -most, most)

    def text(self, plant: Plant) -> str:
        more = f", and {self.amount(plant, self.sizes[1])}" if self.sizes[1] > 0 else ""
        name = plant.joint_name(self.joint)
        return f"the friction of {name} depends on the load ({100 * self.sizes[0]:.3g} % of it{more})"


@dataclass(frozen=True)
class Inertia(Cause):
    """Joints have another inertia. Size: the inertia divided by that of M.

    Attributes:
        joints: those whose accelerations are divided by the size.
        dt: seconds.
    """

    name: ClassVar[str] = "inertia"
    joints: tuple[Joint, ...] = ()
    dt: float = 1.0

    def pushed(self, model: Model, x: Array, u: Array, free: Array, reached: Array) -> Array:
        changed = np.array(reached)
        for joint in self.joints:
            gained = (1.0 / self.sizes[0] - 1.0) * (reached[..., joint.rate] - x[..., joint.rate])
            changed[..., joint.rate] += gained
            if joint.position is not None:
                changed[..., joint.position] += joint.share * self.dt * gained
        return changed

    def text(self, plant: Plant) -> str:
        names = " and ".join(plant.joint_name(joint) for joint in self.joints)
        return f"{names} {'has' if len(self.joints) == 1 else 'have'} {self.sizes[0]:.3g} times the inertia of M"


@dataclass(frozen=True)
class Gravity(Cause):
    """What pulls at joints at rest has another size, such as the weight of links. Size: divided by that of M.

    Attributes:
        joints: those that it pulls at.
        rates: indices of all states that are 0 at rest.
        dt: seconds.
    """

    name: ClassVar[str] = "gravity"
    joints: tuple[Joint, ...] = ()
    rates: tuple[int, ...] = ()
    dt: float = 1.0

    def pushed(self, model: Model, x: Array, u: Array, free: Array, reached: Array) -> Array:
        still, changed = np.array(x), np.array(reached)
        still[..., list(self.rates)] = 0.0
        pulled = (self.sizes[0] - 1.0) * np.asarray(model.step(still, np.zeros_like(u)))
        for joint in self.joints:
            changed[..., joint.rate] += pulled[..., joint.rate]
            if joint.position is not None:
                changed[..., joint.position] += joint.share * self.dt * pulled[..., joint.rate]
        return changed

    def text(self, plant: Plant) -> str:
        names = " and ".join(plant.joint_name(joint) for joint in self.joints)
        return f"the weights (or the springs) that pull at {names} are {self.sizes[0]:.3g} times those of M"


@dataclass(frozen=True)
class TimeStep(Cause):
    """A step of M takes another time than that of the system. Size: the steps of M in one step of the system."""

    name: ClassVar[str] = "time step"

    def pushed(self, model: Model, x: Array, u: Array, free: Array, reached: Array) -> Array:
        return x + self.sizes[0] * (reached - x)

    def text(self, plant: Plant) -> str:
        step, taken = 1e3 * plant.dt, 1e3 * plant.dt * self.sizes[0]
        return f"one step of the system takes {taken:.4g} ms of M, and not {step:.4g} ms"


def _of_dof(plant: Plant, joint: Joint, attribute: str, field: str, added: float) -> str | None:
    if joint.dof is None:
        return None
    value = float(getattr(plant.model.compiled, field)[joint.dof]) + added  # type: ignore[attr-defined]
    return f'<joint name="{plant.mjcf_name(joint)}" {attribute}="{value:.5g}"/>'
