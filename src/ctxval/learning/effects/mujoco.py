"""Attributes of a MuJoCo model that differ: of joints and of bodies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory
from ctxval.core.uncertain import UncertainParameter
from ctxval.errors import InputError
from ctxval.learning.effects.effect import Effect, EffectCandidate, Observed, Parameter, Size, of_ratio, of_size
from ctxval.learning.effects.plant import Joint, Plant, plant_of
from ctxval.models import MuJoCo
from ctxval.models.mujoco_parameters import drawn_fields, uncertain_parameters


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

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        plant, compiled = observed.plant, observed.plant.compiled
        inertias = None if compiled is None else _inertias(compiled)
        for joint in plant.joints:
            if inertias is None or observed.missed[joint.rate] <= 1e-6 * plant.changes[joint.rate]:
                continue  # the joint has no fault
            inertia = float(inertias[joint.dof])
            force = inertia * float(observed.missed[joint.rate]) / plant.dt
            speed = max(float(plant.changes[joint.position]) / plant.dt, 1e-9)
            for attribute, size in (("damping", force / speed), ("frictionloss", force), ("armature", inertia)):
                low = -float(getattr(compiled, f"dof_{attribute}")[joint.dof])
                starts = (0.3 * size, size) if attribute == "frictionloss" else (0.0,)
                # More damping would make the integration unstable.
                most = min(20 * size, inertia / compiled.opt.timestep) if attribute == "damping" else 20 * size
                effect = cls((0.0,), attribute, joint)
                yield of_size(effect, Parameter(attribute, low, most, 0.05 * size, effect.unit(plant)), *starts)

    def unit(self, plant: Plant) -> str:
        """Return the unit of the attribute."""
        force, angular = plant.force_unit(self.joint), plant.force_unit(self.joint) == "N m"
        if self.attribute == "armature":
            return "kg m^2" if angular else "kg"
        return f"{force} {'s/rad' if angular else 's/m'}" if self.attribute == "damping" else force

    def change(self, compiled: Any) -> None:
        getattr(compiled, f"dof_{self.attribute}")[self.joint.dof] += self.sizes[0]

    def sentence(self, plant: Plant) -> str:
        name, size, unit = plant.joint_name(self.joint), self.sizes[0], self.unit(plant)
        if self.attribute == "frictionloss":
            return f"{name} sticks ({size:.3g} {unit})"
        what = "viscous friction" if self.attribute == "damping" else "inertia of the rotor"
        return f"{name} has {'more' if size >= 0 else 'less'} {what} than M ({abs(size):.3g} {unit})"

    def repair(self, plant: Plant) -> dict[str, str]:
        value = float(getattr(plant.compiled, f"dof_{self.attribute}")[self.joint.dof]) + self.sizes[0]
        lines = {"mjcf": f'<joint name="{plant.joint_name(self.joint)}" {self.attribute}="{value:.5g}"/>'}
        if self.attribute != "armature":
            lines["urdf"] = f'<dynamics {self.attribute.removesuffix("loss")}="{value:.5g}"/>'
        return lines


@dataclass(frozen=True)
class SharedAttribute(OfMuJoCo):
    """An attribute of many elements differs. Size: the factor of its values, or what is added to them, in SI units."""

    name: ClassVar[str] = "shared attribute"
    parameter: str = "friction"  #: a name of an uncertain parameter, as :class:`ctxval.models.MuJoCo` takes it
    added: bool = False  #: whether the size is added

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        return cls.of_elements(observed, 2)  # of one element, other effects of the dictionary are the same

    @classmethod
    def of_elements(cls, observed: Observed, joints: int) -> Iterator[EffectCandidate]:
        """Return attributes of so many joints at least, of geoms and of the model; none without a MuJoCo model."""
        plant, compiled = observed.plant, observed.plant.compiled
        if compiled is None:
            return
        # Without ground, sensors are as likely tilted.
        ground = bool(((compiled.geom_bodyid == 0) & ((compiled.geom_contype | compiled.geom_conaffinity) > 0)).any())
        several = {"friction"} if ground else set[str]()
        several |= {"damping", "armature", "stiffness"} if len(plant.joints) >= joints else set()
        several |= {"gain"} if compiled.actuator_biasprm.any() else set()
        own = [each.name for each in plant.model.uncertain if "[" in each.name]  # type: ignore[attr-defined]
        for name in dict.fromkeys((*sorted(several), *own)):
            with suppress(InputError):  # its values are 0
                uncertain_parameters(compiled, {name: "10 %"})
                if not name.startswith(("mass", "centre")):
                    yield of_size(cls((1.0,), name), Parameter(name, 0.1, 10.0, 0.1), 0.95, 1.1)
        inertias, driven = _inertias(compiled), [joint for joint in plant.joints if joint.input is not None]
        forces = [float(inertias[joint.dof] * observed.missed[joint.rate] / plant.dt) for joint in driven]
        if len(forces) >= joints and max(forces) > 0:
            size = float(np.median(forces))
            parameter = Parameter("frictionloss", 0.0, 20 * max(forces), 0.05 * max(size, 1e-9))
            yield of_size(cls((0.0,), "frictionloss", True), parameter, 0.3 * size, size)
        most = float(np.linalg.norm(compiled.opt.gravity))
        for axis in "xy" if ground and most > 0 else "":
            tilt = Parameter(f"gravity_{axis}", -0.5 * most, 0.5 * most, 0.01 * most, "m/s^2")
            yield of_size(cls((0.0,), f"gravity_{axis}", True), tilt, 0.0)
        for body in _floating(compiled) if joints < 2 else ():  # otherwise, MassCentre is this effect
            for axis in "xyz":
                effect = cls((0.0,), f"centre_{axis}[{compiled.body(body).name}]", True)
                yield of_size(effect, _shift(_extent(compiled, body)), 0.0)

    @property
    def unit(self) -> float | str:
        """The deviation of the uncertain parameter that it is."""
        return 1.0 if self.added else "100 %"

    @property
    def standardised(self) -> Array:
        """The values of this parameter for its sizes, those of draws or one ``(S, 1)``."""
        sizes = np.reshape(self.sizes[0], (-1, 1))
        return sizes if self.added else np.log(sizes)

    def change(self, compiled: Any) -> None:
        parameters = uncertain_parameters(compiled, {self.parameter: self.unit})
        for field, values in drawn_fields(compiled, parameters, self.standardised).items():
            target = compiled.opt.gravity if field == "opt.gravity" else getattr(compiled, field)
            target[:] = values[0]

    def sentence(self, plant: Plant) -> str:
        size, axis = self.sizes[0], self.parameter[-1]
        if self.parameter.startswith("gravity"):
            slope = np.degrees(np.arctan(size / np.linalg.norm(plant.compiled.opt.gravity)))
            return f"gravity has a part of {size:.3g} m/s^2 along {axis}, as on a slope of {abs(slope):.2g} degrees"
        if self.parameter.startswith("centre"):
            quantity, _, body = self.parameter.rstrip("]").partition("[")
            return _shifted(body, size, quantity[-1])
        if self.added:
            return f"all driven joints stick ({size:.3g} N m)"
        return f"{self.parameter} is {size:.3g} times that of M"


def attribute_of(prior: UncertainParameter, value: float) -> EffectCandidate:
    """Return a value of an uncertain parameter of a model as an effect of M."""
    effect = SharedAttribute((value,), prior.name, added=not prior.relative)
    if prior.relative:
        return of_size(effect, Parameter(prior.name, 0.1, 10.0, 0.1), value)
    most = 20 * prior.deviation + abs(value)
    return of_size(effect, Parameter(prior.name, -most, most, 0.25 * prior.deviation), value)


def further_attributes(model: Model, runs: Sequence[Trajectory]) -> tuple[EffectCandidate, ...]:
    """Return the attributes in which executions may differ from a model beside its uncertain parameters."""
    if not isinstance(model, MuJoCo):
        return ()
    x, x_next = (np.concatenate([run.states[rows] for run in runs]) for rows in (slice(-1), slice(1, None)))
    u = np.concatenate([run.inputs for run in runs])
    states, inputs = ({f"{name}{k}": "" for k in range(part.shape[1])} for name, part in (("x", x), ("u", u)))
    with np.errstate(all="ignore"):
        missed = model.geometry.difference(model.step(x, u), x_next)
    usable = np.isfinite(missed).all(axis=1)
    plant, sizes = plant_of(model, model.dt, states, inputs, x, u), np.sqrt((missed[usable] ** 2).mean(axis=0))
    named = {each.name.partition("[")[0] for each in model.uncertain}
    shared = SharedAttribute.of_elements(Observed(plant, x, u, sizes, 0.0, estimated=False), 1)
    return tuple(each for each in shared if each.parameters[0].name.partition("[")[0] not in named)


@dataclass(frozen=True)
class BodyMass(OfMuJoCo):
    """A body is heavier or lighter, with the same shape. Size: its mass divided by that in M."""

    name: ClassVar[str] = "mass"
    body: int = 1

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        for body in _heaviest(observed.plant.compiled):
            yield of_ratio(cls((1.0,), body))

    def change(self, compiled: Any) -> None:
        compiled.body_mass[self.body] *= self.sizes[0]
        compiled.body_inertia[self.body] *= self.sizes[0]

    def sentence(self, plant: Plant) -> str:
        compiled = plant.compiled
        name, mass = compiled.body(self.body).name or f"body {self.body}", float(compiled.body_mass[self.body])
        return f"{name} has a mass of {self.sizes[0] * mass:.3g} kg and not of {mass:.3g} kg"

    def repair(self, plant: Plant) -> dict[str, str]:
        compiled = plant.compiled
        mass = self.sizes[0] * float(compiled.body_mass[self.body])
        inertia = " ".join(f"{self.sizes[0] * value:.5g}" for value in compiled.body_inertia[self.body])
        place = " ".join(f"{value:.5g}" for value in compiled.body_ipos[self.body])
        turn = " ".join(f"{value:.5g}" for value in compiled.body_iquat[self.body])
        line = f'<inertial mass="{mass:.5g}" diaginertia="{inertia}" pos="{place}" quat="{turn}"/>'
        return {"mjcf": line, "urdf": f'<mass value="{mass:.5g}"/>'}


@dataclass(frozen=True)
class MassCentre(OfMuJoCo):
    """The centre of mass of a body lies elsewhere. Size: the shift in metres along an axis of the body."""

    name: ClassVar[str] = "centre of mass"
    body: int = 1
    axis: int = 0

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        compiled = observed.plant.compiled
        for body in _heaviest(compiled):
            extent = _extent(compiled, body)
            for axis in range(3 if extent > 0 else 0):
                yield of_size(cls((0.0,), body, axis), _shift(extent), 0.0)

    def change(self, compiled: Any) -> None:
        compiled.body_ipos[self.body, self.axis] += self.sizes[0]

    def sentence(self, plant: Plant) -> str:
        name = plant.compiled.body(self.body).name or f"body {self.body}"
        return _shifted(name, self.sizes[0], "xyz"[self.axis])

    def repair(self, plant: Plant) -> dict[str, str]:
        place = np.array(plant.compiled.body_ipos[self.body])
        place[self.axis] += self.sizes[0]
        where = " ".join(f"{value:.5g}" for value in place)
        return {"mjcf": f'<inertial pos="{where}"/>', "urdf": f'<origin xyz="{where}"/>'}


def _inertias(compiled: Any) -> Array:
    """Return the inertia of each degree of freedom in the initial pose, shape ``(nv,)``."""
    import mujoco

    data, inertias = mujoco.MjData(compiled), np.zeros((compiled.nv, compiled.nv))
    mujoco.mj_forward(compiled, data)
    mujoco.mj_fullM(compiled, data, inertias)
    return np.asarray(np.abs(np.diagonal(inertias)))


def _extent(compiled: Any, body: int) -> float:
    """Return the largest radius of gyration of a body, metres."""
    return float(np.sqrt(compiled.body_inertia[body].max() / compiled.body_mass[body]))


def _shift(extent: float) -> Parameter:
    return Parameter("centre of mass", -3 * extent, 3 * extent, 0.05 * extent, "m")


def _shifted(body: str, size: Size, axis: str) -> str:
    return f"the centre of mass of {body} is shifted by {size:.3g} m along its {axis} axis"


def _floating(compiled: Any) -> list[int]:
    """Return the bodies with free joints, which have names, masses and an extent."""
    bodies = compiled.jnt_bodyid[compiled.jnt_type == 0].tolist()
    named = [body for body in bodies if compiled.body(body).name and compiled.body_mass[body] > 0]
    return [body for body in named if _extent(compiled, body) > 0]


def _heaviest(compiled: Any) -> list[int]:
    """Return the bodies that move, the heaviest ones first; none without a model of MuJoCo."""
    if compiled is None:
        return []
    masses = compiled.body_mass
    moved = (compiled.body_dofnum > 0) | (compiled.body_parentid > 0)
    bodies = [body for body in range(1, compiled.nbody) if masses[body] > 0 and moved[body]]
    return sorted(bodies, key=lambda each: -float(masses[each]))[:8]
