"""Attributes of a MuJoCo model that differ: of joints and of bodies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.model import Model
from ctxval.learning.effects.effect import Effect, EffectCandidate, of_ratio, of_size
from ctxval.learning.effects.plant import Joint, Plant


@dataclass(frozen=True)
class OfMuJoCo(Effect):
    """An attribute of a MuJoCo model that differs."""

    def change(self, compiled: Any) -> None:
        """Change a copy of the compiled model, a ``mujoco.MjModel``."""
        raise NotImplementedError

    def model(self, model: Any) -> Model:
        return model.changed(self.change)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class JointAttribute(OfMuJoCo):
    """Damping, Coulomb friction or armature of a joint. Size: what is added to the value in M, in SI units."""

    name: ClassVar[str] = "joint attribute"
    attribute: str = "damping"  #: ``damping``, ``frictionloss`` or ``armature``
    joint: Joint = Joint(0)  # noqa: RUF009  # it is frozen

    def change(self, compiled: Any) -> None:
        getattr(compiled, f"dof_{self.attribute}")[self.joint.dof] += self.sizes[0]

    def text(self, plant: Plant) -> str:
        name, unit, size = plant.joint_name(self.joint), plant.force_unit(self.joint), self.sizes[0]
        if self.attribute == "frictionloss":
            return f"{name} sticks ({size:.3g} {unit})"
        more = "more" if size >= 0 else "less"
        if self.attribute == "damping":
            per = "s/rad" if unit == "N m" else "s/m"
            return f"{name} has {more} viscous friction than M ({abs(size):.3g} {unit} {per})"
        return f"{name} has {more} inertia of the rotor than M ({abs(size):.3g} {'kg m^2' if unit == 'N m' else 'kg'})"

    def mjcf(self, plant: Plant) -> str | None:
        value = float(getattr(plant.compiled, f"dof_{self.attribute}")[self.joint.dof]) + self.sizes[0]
        return f'<joint name="{plant.joint_name(self.joint)}" {self.attribute}="{value:.5g}"/>'


@dataclass(frozen=True)
class BodyMass(OfMuJoCo):
    """A body is heavier or lighter, with the same shape. Size: its mass divided by that in M."""

    name: ClassVar[str] = "mass"
    body: int = 1

    def change(self, compiled: Any) -> None:
        compiled.body_mass[self.body] *= self.sizes[0]
        compiled.body_inertia[self.body] *= self.sizes[0]

    def text(self, plant: Plant) -> str:
        compiled = plant.compiled
        name, mass = compiled.body(self.body).name or f"body {self.body}", float(compiled.body_mass[self.body])
        return f"{name} has a mass of {self.sizes[0] * mass:.3g} kg and not of {mass:.3g} kg"

    def mjcf(self, plant: Plant) -> str | None:
        compiled = plant.compiled
        mass = self.sizes[0] * float(compiled.body_mass[self.body])
        inertia = " ".join(f"{self.sizes[0] * value:.5g}" for value in compiled.body_inertia[self.body])
        place = " ".join(f"{value:.5g}" for value in compiled.body_ipos[self.body])
        turn = " ".join(f"{value:.5g}" for value in compiled.body_iquat[self.body])
        return f'<inertial mass="{mass:.5g}" diaginertia="{inertia}" pos="{place}" quat="{turn}"/>'


@dataclass(frozen=True)
class MassCentre(OfMuJoCo):
    """The centre of mass of a body lies elsewhere. Size: the shift in metres along an axis of the body."""

    name: ClassVar[str] = "centre of mass"
    body: int = 1
    axis: int = 0

    def change(self, compiled: Any) -> None:
        compiled.body_ipos[self.body, self.axis] += self.sizes[0]

    def text(self, plant: Plant) -> str:
        name = plant.compiled.body(self.body).name or f"body {self.body}"
        return f"the centre of mass of {name} is shifted by {self.sizes[0]:.3g} m along its {'xyz'[self.axis]} axis"

    def mjcf(self, plant: Plant) -> str | None:
        place = np.array(plant.compiled.body_ipos[self.body])
        place[self.axis] += self.sizes[0]
        return f'<inertial pos="{" ".join(f"{value:.5g}" for value in place)}"/>'


def of_mujoco(plant: Plant, missed: Array) -> Iterator[EffectCandidate]:
    """Yield what may be wrong with joints and bodies of a model of MuJoCo."""
    import mujoco

    compiled = plant.compiled
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    inertias = np.zeros((compiled.nv, compiled.nv))
    mujoco.mj_fullM(compiled, data, inertias)
    for joint in plant.joints:
        if missed[joint.rate] <= 1e-6 * plant.changes[joint.rate]:  # the joint has no fault
            continue
        inertia = float(np.abs(inertias[joint.dof, joint.dof]))
        force = inertia * float(missed[joint.rate]) / plant.dt
        speed = max(float(plant.changes[joint.position]) / plant.dt, 1e-9)
        for attribute, size in (("damping", force / speed), ("frictionloss", force), ("armature", inertia)):
            low = -float(getattr(compiled, f"dof_{attribute}")[joint.dof])
            starts = (0.3 * size, size) if attribute == "frictionloss" else (0.0,)
            # More damping would make the integration unstable.
            most = min(20 * size, inertia / compiled.opt.timestep) if attribute == "damping" else 20 * size
            yield of_size(JointAttribute((0.0,), attribute, joint), low, most, 0.05 * size, *starts)
    masses = compiled.body_mass
    moved = (compiled.body_dofnum > 0) | (compiled.body_parentid > 0)
    bodies = [body for body in range(1, compiled.nbody) if masses[body] > 0 and moved[body]]
    for body in sorted(bodies, key=lambda each: -float(masses[each]))[:8]:
        yield of_ratio(BodyMass((1.0,), body))
        extent = float(np.sqrt(compiled.body_inertia[body].max() / masses[body]))
        for axis in range(3 if extent > 0 else 0):
            yield of_size(MassCentre((0.0,), body, axis), -3 * extent, 3 * extent, 0.05 * extent, 0.0)
