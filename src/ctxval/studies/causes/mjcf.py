"""Causes that are attributes of a MuJoCo model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ctxval.core.model import Model
from ctxval.models import MuJoCo
from ctxval.studies.causes.cause import Cause
from ctxval.studies.causes.plant import Joint, Plant


@dataclass(frozen=True)
class JointAttribute(Cause):
    """Damping, Coulomb friction or armature of a joint. Size: what is added to the value in M, in SI units.

    Attributes:
        attribute: ``damping``, ``frictionloss`` or ``armature``.
    """

    name: ClassVar[str] = "joint attribute"
    attribute: str = "damping"
    joint: Joint = Joint(0)  # noqa: RUF009  # it is frozen

    def model(self, model: Model) -> Model:
        def change(compiled: Any) -> None:
            getattr(compiled, f"dof_{self.attribute}")[self.joint.dof] += self.sizes[0]

        assert isinstance(model, MuJoCo)
        return model.changed(change)

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
        value = float(getattr(plant.model.compiled, f"dof_{self.attribute}")[self.joint.dof]) + self.sizes[0]  # type: ignore[attr-defined]
        return f'<joint name="{plant.mjcf_name(self.joint)}" {self.attribute}="{value:.5g}"/>'


@dataclass(frozen=True)
class BodyMass(Cause):
    """A body is heavier or lighter, with the same shape. Size: its mass divided by that in M."""

    name: ClassVar[str] = "mass"
    body: int = 1

    def model(self, model: Model) -> Model:
        def change(compiled: Any) -> None:
            compiled.body_mass[self.body] *= self.sizes[0]
            compiled.body_inertia[self.body] *= self.sizes[0]

        assert isinstance(model, MuJoCo)
        return model.changed(change)

    def text(self, plant: Plant) -> str:
        compiled = plant.model.compiled  # type: ignore[attr-defined]
        name, mass = compiled.body(self.body).name or f"body {self.body}", float(compiled.body_mass[self.body])
        return f"{name} has a mass of {self.sizes[0] * mass:.3g} kg and not of {mass:.3g} kg"

    def mjcf(self, plant: Plant) -> str | None:
        compiled = plant.model.compiled  # type: ignore[attr-defined]
        mass = self.sizes[0] * float(compiled.body_mass[self.body])
        inertia = " ".join(f"{self.sizes[0] * value:.5g}" for value in compiled.body_inertia[self.body])
        place = " ".join(f"{value:.5g}" for value in compiled.body_ipos[self.body])
        turn = " ".join(f"{value:.5g}" for value in compiled.body_iquat[self.body])
        return f'<inertial mass="{mass:.5g}" diaginertia="{inertia}" pos="{place}" quat="{turn}"/>'


@dataclass(frozen=True)
class MassCentre(Cause):
    """The centre of mass of a body lies elsewhere. Size: the shift in metres along an axis of the body."""

    name: ClassVar[str] = "centre of mass"
    body: int = 1
    axis: int = 0

    def model(self, model: Model) -> Model:
        def change(compiled: Any) -> None:
            compiled.body_ipos[self.body, self.axis] += self.sizes[0]

        assert isinstance(model, MuJoCo)
        return model.changed(change)

    def text(self, plant: Plant) -> str:
        name = plant.model.compiled.body(self.body).name or f"body {self.body}"  # type: ignore[attr-defined]
        return f"the centre of mass of {name} is shifted by {self.sizes[0]:.3g} m along its {'xyz'[self.axis]} axis"

    def mjcf(self, plant: Plant) -> str | None:
        place = np.array(plant.model.compiled.body_ipos[self.body])  # type: ignore[attr-defined]
        place[self.axis] += self.sizes[0]
        return f'<inertial pos="{" ".join(f"{value:.5g}" for value in place)}"/>'
