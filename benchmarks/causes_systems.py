"""Robots with one fault that their models lack, for ``study_causes.py``.

The faults are simulated here in their own way, in 20 parts of a step, and not with the code that finds them. The robots
themselves are those of ``causes_robots.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from ctxval import Array, Experiment, Task, Trajectory, rollout, systems
from ctxval.core.controller import Controller
from ctxval.core.model import Model

PARTS = 20
Acceleration = Callable[[Array, Array, Array, float], Array]
"""Takes positions, rates, forces on the joints and the strength of gravity."""


@dataclass(frozen=True)
class Fault:
    """A fault of a robot.

    Attributes:
        kind: as the dictionary of causes names it; foreign ones are in no dictionary.
        place: the index of the joint or of the input.
        sizes: in physical units, as the dictionary has them.
    """

    kind: str
    place: int = 0
    sizes: tuple[float, ...] = ()
    foreign: bool = False


@dataclass(frozen=True)
class Robot:
    """A robot with its exact model.

    Attributes:
        joints, inputs: numbers of them.
        driven: the joint of each input.
        rates: typical rates of the joints.
        efforts: typical magnitudes of the inputs.
        weights: joints that gravity pulls at.
    """

    name: str
    joints: int
    inputs: int
    driven: tuple[int, ...]
    dt: float
    rates: tuple[float, ...]
    efforts: tuple[float, ...]
    model: Model
    make: Callable[[Robot, Any], Experiment]
    acceleration: Acceleration | None = None
    mjcf: Path | None = None
    weights: tuple[int, ...] = ()
    joint_efforts: tuple[float, ...] = ()

    def constant_weight(self, joint: int) -> float | None:
        """Return what gravity alone accelerates a joint by; None if it depends on the positions."""
        if self.acceleration is None or joint not in self.weights:
            return None
        still = np.zeros(self.joints)
        at = np.random.default_rng(0).uniform(-1, 1, (5, self.joints))
        pulls = [self.acceleration(q, still, still, 1.0) - self.acceleration(q, still, still, 0.0) for q in at]
        return float(pulls[0][joint]) if np.ptp(pulls, axis=0)[joint] < 1e-9 else None

    def experiment(self, fault: Fault, noise: float, seed: int) -> Experiment:
        """Return the experiment with a fault, and measurement noise in shares of the range of each state."""
        return self.make(self, Faulty(self, fault, noise, seed))


@dataclass(eq=False)
class Faulty:
    """A robot with a fault as the system S, one task at a time."""

    robot: Robot
    fault: Fault
    noise: float = 0.0
    seed: int = 0
    executed: int = field(default=0)

    def describe(self) -> dict[str, Any]:
        return {"robot": self.robot.name, "fault": vars(self.fault), "noise": self.noise, "seed": self.seed}

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        robot, fault = self.robot, self.fault
        rng = np.random.default_rng([self.seed, self.executed])
        self.executed += 1
        commanded: list[Array] = []
        acting, play, h = np.zeros(robot.inputs), np.zeros(robot.inputs), robot.dt / PARTS
        mechanics = _Analytic(robot, fault, task) if robot.mjcf is None else _OfMuJoCo(robot, fault, task)

        def record(x: Array) -> Array:
            y = np.array(x)
            n = robot.joints if robot.mjcf is None else len(y) // 2
            place = fault.place
            if fault.kind == "sensor offset":
                y[place] += fault.sizes[0]
            if fault.kind == "sensor scale":
                y[[place, n + place]] *= fault.sizes[0]
            if fault.kind == "swapped joints":
                y[[0, 1, n, n + 1]] = y[[1, 0, n + 1, n]]
            return y + self.noise * spread * rng.standard_normal(len(y))

        spread = np.concatenate([np.array(robot.rates), 2 * np.array(robot.rates)])
        if robot.mjcf is not None:
            wide = np.zeros(len(task.initial_state))
            n = len(wide) // 2
            wide[: robot.joints], wide[n : n + robot.joints] = spread[: robot.joints], spread[robot.joints :]
            spread = wide

        def step(_: Array, u: Array) -> Array:
            nonlocal acting, play
            commanded.append(_of_inputs(fault, np.array(u)))
            for part in range(PARTS):
                late = fault.sizes[0] if fault.kind == "delay" else 0.0
                back = int(np.ceil(late - part / PARTS - 1e-9))
                due = commanded[-1 - back] if back < len(commanded) else np.zeros(robot.inputs)
                if fault.kind == "lag":
                    acting = acting + (due - acting) * (1 - np.exp(-1 / PARTS / fault.sizes[0]))
                elif fault.kind == "backlash":
                    width = np.zeros(robot.inputs)
                    width[fault.place] = fault.sizes[0]
                    acting = np.clip(acting, due - width, due + width)
                else:
                    acting = due
                mechanics.advance(acting, h * (fault.sizes[0] if fault.kind == "time step" else 1.0))
            return record(mechanics.state)

        return rollout(step, controller, task.starting_at(record(mechanics.state)))


def _of_inputs(fault: Fault, u: Array) -> Array:
    k = fault.place
    if fault.kind == "input gain":
        u[k] *= fault.sizes[0]
    if fault.kind == "input offset":
        u[k] += fault.sizes[0]
    if fault.kind == "saturation":
        u[k] = np.clip(u[k], -fault.sizes[0], fault.sizes[0])
    if fault.kind == "dead zone":
        u[k] = np.sign(u[k]) * max(abs(u[k]) - fault.sizes[0], 0.0)
    if fault.kind == "swapped inputs":
        u[[0, 1]] = u[[1, 0]]
    if fault.kind == "curved input":
        u[k] = u[k] - fault.sizes[0] * u[k] * abs(u[k])
    return u


def _joint_forces(robot: Robot, fault: Fault, q: Array, v: Array, load: Array, time: float) -> Array:
    """Return the forces of a fault on the joints, in SI units."""
    forces = np.zeros(robot.joints)
    j, sizes = fault.place, fault.sizes
    slow = np.tanh(v[j] / (5e-3 * robot.rates[j])) if j < robot.joints else 0.0
    if fault.kind == "bias":
        forces[j] = sizes[0]
    if fault.kind == "viscous friction":
        forces[j] = -sizes[0] * v[j]
    if fault.kind == "Coulomb friction":
        forces[j] = -sizes[0] * slow
    if fault.kind == "Stribeck friction":
        forces[j] = -(sizes[0] + sizes[1] * np.exp(-((v[j] / sizes[2]) ** 2))) * slow
    if fault.kind == "load-dependent friction":
        forces[j] = -(sizes[0] * abs(load[j]) + sizes[1]) * slow
    if fault.kind == "cogging":
        forces[j] = sizes[0] * np.sin(sizes[1] * q[j])
    if fault.kind == "hard spring":
        forces[j] = -sizes[0] * q[j] ** 3
    if fault.kind == "fan":
        forces[j] = sizes[0] * np.sin(sizes[1] * time)
    if fault.kind == "cable":
        forces[j] = -sizes[0] * (q[j] - q[(j + 1) % robot.joints])
    return forces


class _Analytic:
    """The mechanics of a robot whose accelerations are known in closed form."""

    def __init__(self, robot: Robot, fault: Fault, task: Task) -> None:
        self.robot, self.fault, self.time = robot, fault, 0.0
        self.state = np.array(task.initial_state, dtype=np.float64)
        if fault.kind == "sensor scale":  # what is recorded is the initial state of the task
            self.state[[fault.place, robot.joints + fault.place]] /= fault.sizes[0]

    def advance(self, u: Array, h: float) -> None:
        robot, fault, n = self.robot, self.fault, self.robot.joints
        assert robot.acceleration is not None
        strength = fault.sizes[0] if fault.kind == "gravity" else 1.0
        heavier = fault.sizes[0] if fault.kind == "inertia" else 1.0

        def derivative(x: Array, u: Array) -> Array:
            assert robot.acceleration is not None
            q, v = x[:n], x[n:]
            forces = np.zeros(n)
            forces[list(robot.driven)] = u
            # What the motor does against what else pulls, as published for servos (arXiv 2410.08650).
            load = forces - self._external(q)
            forces = forces + _joint_forces(robot, fault, q, v, load, self.time)
            acceleration = robot.acceleration(q, v, forces, strength)
            if fault.kind == "inertia":
                acceleration[fault.place] /= heavier
            return np.concatenate([v, acceleration])

        self.state = systems.rk4(derivative, h)(self.state, u)
        self.time += h

    def _external(self, q: Array) -> Array:
        """Return the torques of gravity: those that would have to be added without it."""
        robot, still = self.robot, np.zeros(self.robot.joints)
        assert robot.acceleration is not None
        gained = robot.acceleration(q, still, still, 1.0) - robot.acceleration(q, still, still, 0.0)
        unit = robot.acceleration(q, still, still, 0.0)
        inverse = np.stack([robot.acceleration(q, still, e, 0.0) - unit for e in np.eye(robot.joints)], axis=1)
        return np.linalg.solve(inverse, gained)


class _OfMuJoCo:
    """The mechanics of a robot of MuJoCo, with the time step of its model, and the mean of the inputs over each step.

    A model of MuJoCo is exact for its time step only: with a smaller one, a robot would have a second fault.
    """

    def __init__(self, robot: Robot, fault: Fault, task: Task) -> None:
        self.robot, self.fault, self.inputs = robot, fault, list[Array]()
        self.model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
        self.parts = round(PARTS * self.model.opt.timestep / robot.dt)
        if fault.kind == "viscous friction":
            self.model.dof_damping[fault.place] += fault.sizes[0]
        if fault.kind == "armature":
            self.model.dof_armature[fault.place] += fault.sizes[0]
        if fault.kind == "mass":
            self.model.body_mass[fault.place] *= fault.sizes[0]
            self.model.body_inertia[fault.place] *= fault.sizes[0]
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setConst(self.model, self.data)
        x = np.array(task.initial_state, dtype=np.float64)
        if fault.kind == "sensor scale":
            x[[fault.place, len(x) // 2 + fault.place]] /= fault.sizes[0]
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos, self.data.qvel = x[: self.model.nq], x[self.model.nq :]

    @property
    def state(self) -> Array:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def advance(self, u: Array, h: float) -> None:
        self.inputs.append(u)
        if len(self.inputs) < self.parts:
            return
        data, fault, j, sizes = self.data, self.fault, self.fault.place, self.fault.sizes
        self.model.opt.timestep = h * self.parts
        data.ctrl = np.mean(self.inputs, axis=0)
        self.inputs.clear()
        if fault.kind == "Coulomb friction":
            self.model.dof_frictionloss[j] = sizes[0]
        elif fault.kind == "Stribeck friction":
            self.model.dof_frictionloss[j] = sizes[0] + sizes[1] * np.exp(-((data.qvel[j] / sizes[2]) ** 2))
        elif fault.kind == "load-dependent friction":
            mujoco.mj_forward(self.model, data)
            self.model.dof_frictionloss[j] = sizes[0] * abs(data.qfrc_actuator[j] + data.qfrc_bias[j]) + sizes[1]
        elif fault.foreign:
            n = self.robot.joints
            data.qfrc_applied[:n] = _joint_forces(
                self.robot, fault, data.qpos[:n], data.qvel[:n], np.zeros(n), data.time
            )
        mujoco.mj_step(self.model, data)


def _force_of(robot: Robot, joint: int) -> float:
    """Return a typical force on a joint."""
    if robot.joint_efforts:
        return robot.joint_efforts[joint]
    return robot.efforts[robot.driven.index(joint)] if joint in robot.driven else 0.2


def faults_of(robot: Robot, count: int = 10) -> list[Fault]:
    """Return seeded faults of a robot of different kinds; the place and the sizes are random."""
    rng = np.random.default_rng(sum(map(ord, robot.name)))
    joints = list(range(robot.joints)) if robot.mjcf is None else list(robot.driven[:4])
    kinds: list[str] = [
        "viscous friction", "Coulomb friction", "Stribeck friction", "load-dependent friction", "input gain",
        "input offset", "saturation", "dead zone", "backlash", "delay", "lag", "sensor offset", "sensor scale",
        "time step",
    ]  # fmt: skip
    kinds += ["gravity"] if robot.mjcf is None and robot.weights else []
    kinds += ["armature", "mass"] if robot.mjcf is not None else []
    kinds += ["swapped inputs"] if robot.inputs > 1 else []
    chosen = rng.permutation(kinds)[:count].tolist()
    return [_drawn(robot, kind, joints, rng) for kind in chosen]


def _drawn(robot: Robot, kind: str, joints: list[int], rng: np.random.Generator) -> Fault:
    share = float(rng.uniform(0.6, 1.4))
    k = int(rng.integers(min(robot.inputs, len(joints))))
    actuated = [j for j in joints if j in robot.driven]
    j = int(rng.choice(actuated))
    force, effort = _force_of(robot, j), robot.efforts[k]
    of_joints = {
        "viscous friction": (0.3 * force * share,),
        "Coulomb friction": (0.2 * force * share,),
        "Stribeck friction": (0.15 * force * share, 0.15 * force * share, 0.3 * robot.rates[j]),
        "load-dependent friction": (0.2 * share, 0.05 * force),
        "sensor offset": (0.1 * share,),
        "sensor scale": (1 + 0.15 * share,),
        "armature": (0.3 * share,),
    }
    of_inputs = {
        "input gain": (1 - 0.2 * share,),
        "input offset": (0.2 * effort * share,),
        "saturation": (0.5 * effort * share,),
        "dead zone": (0.1 * effort * share,),
        "backlash": (0.1 * effort * share,),
    }
    if kind in of_joints:
        return Fault(kind, j, of_joints[kind])
    if kind in of_inputs:
        return Fault(kind, k, of_inputs[kind])
    others = {
        "delay": (0, (round(1.5 * share, 2),)),
        "lag": (0, (1.5 * share,)),
        "time step": (0, (1 + 0.1 * share,)),
        "gravity": (int(rng.choice(robot.weights)) if robot.weights else 0, (1 + 0.2 * share,)),
        "mass": (int(rng.integers(2, 4)), (1 + 0.3 * share,)),
        "swapped inputs": (0, ()),
    }
    place, sizes = others[kind]
    return Fault(kind, place, sizes)


def foreign_of(robot: Robot) -> list[Fault]:
    """Return seeded faults that no dictionary has."""
    rng = np.random.default_rng(1 + sum(map(ord, robot.name)))
    joints = robot.driven[:4]
    j = int(rng.choice(joints))
    force = _force_of(robot, j)
    share = float(rng.uniform(0.6, 1.4))
    return [
        Fault("cogging", j, (0.3 * force * share, 9.0), foreign=True),
        Fault("hard spring", j, (0.8 * force * share,), foreign=True),
        Fault("fan", j, (0.3 * force * share, 5.0), foreign=True),
        Fault(
            "curved input", robot.driven.index(j), (0.25 / robot.efforts[robot.driven.index(j)] * share,), foreign=True
        ),
    ]
