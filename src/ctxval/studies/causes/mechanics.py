"""Causes in the mechanics: forces that M lacks; inertia, gravity, a time step and attributes of MuJoCo that differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval.core.model import Model
from ctxval.models import MuJoCo
from ctxval.studies.causes.cause import Cause, CauseCandidate, Joint, Plant, of_ratio, of_size
from ctxval.studies.causes.flow import Flow


@dataclass(frozen=True)
class Force(Cause):
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
        accelerated = _accelerations(x.shape[-1], [self.joint], self.dt)[:, self.joint.rate]
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


@dataclass(frozen=True)
class Bias(Force):
    """A constant force. Size: the force."""

    name: ClassVar[str] = "bias"

    def force(self, rate: Array, load: Array | float, stopping: Array) -> Array:
        return np.full_like(stopping, self.sizes[0])

    def text(self, plant: Plant) -> str:
        return f"{plant.joint_name(self.joint)} is pushed by a constant {self.amount(plant, self.sizes[0])}"


@dataclass(frozen=True)
class Viscous(Force):
    """Friction in proportion to the rate. Size: the coefficient; negative if M has too much of it."""

    name: ClassVar[str] = "viscous friction"

    def within(self, flow: Flow) -> Flow:
        drive, rate = self.sizes[0] * self.drive(flow), self.joint.rate
        A = np.array(np.broadcast_to(flow.A, (*drive.shape, drive.shape[-1])))
        A[..., rate] -= drive
        return replace(flow, A=A, d=flow.d - drive * flow.start[..., rate, None])

    def text(self, plant: Plant) -> str:
        rate, more = plant.rate_unit(self.joint), "more" if self.sizes[0] >= 0 else "less"
        size = self.amount(plant, abs(self.sizes[0])) + (f" per {rate}" if rate else "")
        return f"{plant.joint_name(self.joint)} has {more} viscous friction than M ({size})"


@dataclass(frozen=True)
class Coulomb(Force):
    """Friction whose magnitude does not depend on the rate; at rest it holds. Size: the magnitude."""

    name: ClassVar[str] = "Coulomb friction"

    def force(self, rate: Array, load: Array | float, stopping: Array) -> Array:
        return np.clip(stopping, -self.sizes[0], self.sizes[0])

    def text(self, plant: Plant) -> str:
        return f"{plant.joint_name(self.joint)} sticks ({self.amount(plant, self.sizes[0])})"


@dataclass(frozen=True)
class Stribeck(Force):
    """Coulomb friction that is larger at low rates. Sizes: at high rates, what is added at rest, and the rate.

    Armstrong-Helouvry, Dupont and Canudas de Wit, "A survey of models, analysis tools and compensation methods for the
    control of machines with friction", Automatica 30 (1994).
    """

    name: ClassVar[str] = "Stribeck friction"

    def force(self, rate: Array, load: Array | float, stopping: Array) -> Array:
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

    The load is the difference between the force of the motor and what everything else pulls with, as M has it.
    """

    name: ClassVar[str] = "load-dependent friction"
    rates: tuple[int, ...] = ()  #: the rates of all joints that inputs drive

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
        pulls = u - (np.linalg.pinv(effects) @ pulled[..., rates, None])[..., 0]
        return np.asarray(np.abs(pulls[..., self.joint.input]))

    def force(self, rate: Array, load: Array | float, stopping: Array) -> Array:
        most = self.sizes[0] * load + self.sizes[1]
        return np.clip(stopping, -most, most)

    def text(self, plant: Plant) -> str:
        more = f", and {self.amount(plant, self.sizes[1])}" if self.sizes[1] > 1e-3 * self.probe else ""
        name = plant.joint_name(self.joint)
        return f"the friction of {name} depends on the load ({100 * self.sizes[0]:.3g} % of it{more})"


def _accelerations(n: int, joints: Sequence[Joint], dt: float) -> Array:
    """Return the part ``(n, n)`` of derivatives that accelerations of joints make, as M integrates."""
    part = np.zeros((n, n))
    for joint in joints:
        part[joint.rate, joint.rate] = 1.0
        if joint.position is not None:
            part[joint.position, joint.rate] = (joint.share - 0.5) * dt
    return part


@dataclass(frozen=True)
class Inertia(Cause):
    """Joints have another inertia. Size: the inertia divided by that of M."""

    name: ClassVar[str] = "inertia"
    joints: tuple[Joint, ...] = ()  #: those whose accelerations are divided by the size
    dt: float = 1.0  #: seconds

    def within(self, flow: Flow) -> Flow:
        n = flow.start.shape[-1]
        divided = np.eye(n) + (1.0 / self.sizes[0] - 1.0) * _accelerations(n, self.joints, self.dt)
        pushes = tuple((drive @ divided.T, rate, force) for drive, rate, force in flow.pushes)
        return replace(flow, A=divided @ flow.A, d=flow.d @ divided.T, varied=flow.varied @ divided.T, pushes=pushes)

    def text(self, plant: Plant) -> str:
        names = " and ".join(map(plant.joint_name, self.joints))
        return f"{names} {'has' if len(self.joints) == 1 else 'have'} {self.sizes[0]:.3g} times the inertia of M"


@dataclass(frozen=True)
class Gravity(Cause):
    """What pulls at joints at rest has another size, such as the weight of links. Size: divided by that of M."""

    name: ClassVar[str] = "gravity"
    joints: tuple[Joint, ...] = ()  #: those that it pulls at
    rates: tuple[int, ...] = ()  #: indices of all states that are 0 at rest
    dt: float = 1.0  #: seconds

    def within(self, flow: Flow) -> Flow:
        resting, n = np.array(flow.start), flow.start.shape[-1]
        resting[..., list(self.rates)] = 0.0
        pulled = flow.driven(np.asarray(flow.model.step(resting, np.zeros_like(flow.inputs))) - resting)
        more = (self.sizes[0] - 1.0) * _accelerations(n, self.joints, self.dt)
        by_positions = np.delete(np.eye(n), self.rates, axis=0)
        slopes = more @ flow.A @ (by_positions.T @ by_positions)
        return replace(flow, A=flow.A + slopes, d=flow.d + pulled @ more.T)

    def text(self, plant: Plant) -> str:
        names = " and ".join(map(plant.joint_name, self.joints))
        return f"the weights (or the springs) that pull at {names} are {self.sizes[0]:.3g} times those of M"


@dataclass(frozen=True)
class TimeStep(Cause):
    """A step of M takes another time than that of the system. Size: the steps of M in one step of the system."""

    name: ClassVar[str] = "time step"

    def duration(self, model: Model) -> float:
        return 1.0 if isinstance(model, MuJoCo) else self.sizes[0]

    def model(self, model: Model) -> Model:
        if not isinstance(model, MuJoCo):
            return model
        substeps = max(1, round(self.sizes[0] * model.substeps))

        def change(compiled: Any) -> None:
            compiled.opt.timestep *= self.sizes[0] * model.substeps / substeps

        changed = model.changed(change)
        changed.substeps = substeps
        return changed

    def text(self, plant: Plant) -> str:
        step, taken = 1e3 * plant.dt, 1e3 * plant.dt * self.sizes[0]
        return f"one step of the system takes {taken:.4g} ms of M, and not {step:.4g} ms"


@dataclass(frozen=True)
class OfMuJoCo(Cause):
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


def forces(plant: Plant, joint: Joint, x: Array, u: Array, missed: Array) -> Iterator[CauseCandidate]:
    """Yield the forces that may enter at a place, in sizes whose effects are as large as what M misses of its rate."""
    probe = 0.1 * float(plant.commanded[joint.input]) if joint.input is not None and joint.dof is None else 1.0
    rows = slice(None, None, max(1, len(x) // 50))
    effects = Bias((1.0,), joint, probe, plant.dt).drive(Flow.of(plant.model, x[rows], u[rows]))[:, joint.rate]
    effects = effects[np.isfinite(effects)]
    size = float(np.sqrt((effects**2).mean())) if len(effects) else 0.0
    force = float(missed[joint.rate]) / size if size > 0 else 0.0
    speed = float(np.sqrt((x[:, joint.rate] ** 2).mean()))
    if force <= 0 or speed <= 0:
        return
    where = joint, 0.1 * force, plant.dt
    most, least, slope = 20 * force, 0.1 * force, force / speed
    if joint.input is None or joint.dof is not None:  # otherwise it is an offset of the input
        yield of_size(Bias((0.0,), *where), -most, most, least, 0.0)
    if joint.dof is None:
        yield of_size(Viscous((0.0,), *where), -20 * slope, 20 * slope, 0.1 * slope, 0.0)
        yield of_size(Coulomb((0.0,), *where), 0.0, most, least, 0.3 * force, force)
    yield CauseCandidate(
        Stribeck((0.0, 0.0, 1.0), *where),
        (0.0, 0.0, 0.01 * speed),
        (most, most, 2 * speed),
        (least, least, 0.1 * speed),
        ((0.5 * force, 0.5 * force, 0.3 * speed), (0.7 * force, 0.3 * force, 0.1 * speed)),
    )
    starts = ((0.05, 0.0), (0.2, 0.3 * force))
    rates = tuple(dict.fromkeys(port.rate for port in plant.ports if port.input is not None))
    yield CauseCandidate(LoadFriction((0.0, 0.0), *where, rates), (0.0, 0.0), (2.0, most), (0.05, least), starts)


def of_joints(plant: Plant) -> Iterator[CauseCandidate]:
    """Yield what may be wrong with joints of a model that is not of MuJoCo."""
    # The joints have positions, all or none.
    rates = tuple(joint.rate for joint in plant.joints if joint.position is not None)
    together = [plant.joints] if len(plant.joints) > 1 else []
    for joints in (*((joint,) for joint in plant.joints), *together):
        yield of_ratio(Inertia((1.0,), joints, plant.dt))
        if rates:
            yield of_ratio(Gravity((1.0,), joints, rates, plant.dt))


def of_mujoco(plant: Plant, missed: Array) -> Iterator[CauseCandidate]:
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
