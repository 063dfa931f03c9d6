"""Robots with one fault that their models lack, for ``study_causes.py``.

Rules were chosen on the robots of ``DEVELOPMENT`` only; nothing is ever tuned on those of ``REPORTING``. The faults are
simulated here in their own way, in 20 parts of a step, and not with the code that finds them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from ctxval import (
    Array,
    Experiment,
    Parameters,
    Task,
    TaskSpace,
    Trajectory,
    controllers,
    distances,
    models,
    rollout,
    systems,
)
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from dynamics_systems import experiment, path

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
    """The mechanics of a robot of MuJoCo, with a smaller time step."""

    def __init__(self, robot: Robot, fault: Fault, task: Task) -> None:
        self.robot, self.fault = robot, fault
        spec = mujoco.MjSpec.from_file(str(robot.mjcf))
        spec.option.timestep = robot.dt / PARTS
        if fault.kind == "Coulomb friction":
            spec.joints[fault.place].frictionloss = fault.sizes[0]
        self.model = spec.compile()
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
        data, robot, fault = self.data, self.robot, self.fault
        self.model.opt.timestep = h
        data.ctrl = u
        if fault.kind not in ("Coulomb friction", "viscous friction"):
            n = robot.joints
            load = np.zeros(n)
            load[list(robot.driven)] = np.array(self.model.actuator_gear[:, 0]) * u
            load += np.array(data.qfrc_bias[:n])
            data.qfrc_applied[:n] = _joint_forces(robot, fault, data.qpos[:n], data.qvel[:n], load, data.time)
        mujoco.mj_step(self.model, data)


def _analytic_model(joints: int, driven: tuple[int, ...], acceleration: Acceleration, dt: float) -> Model:
    def derivative(x: Array, u: Array) -> Array:
        # The axes of a batch stay in the opposite order until the end.
        forces = np.zeros((*np.broadcast_shapes(x.shape[:-1], u.shape[:-1]), joints))
        forces[..., list(driven)] = u
        accelerations = acceleration(x[..., :joints].T, x[..., joints:].T, forces.T, 1.0)
        return np.concatenate([x[..., joints:], accelerations.T], axis=-1)

    return models.Function(systems.rk4(derivative, dt), vectorized=True)


def _pendulum(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    return (forces - gravity * 4.0 * np.sin(q) - 0.1 * v) / 0.5


def _crane(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    mass, load, length = 1.0, 0.4, 0.6
    s, c = np.sin(q[1]), np.cos(q[1])
    m11, m12, m22 = mass + load, load * length * c, load * length**2
    b1 = forces[0] + load * length * v[1] ** 2 * s - 0.2 * v[0]
    b2 = forces[1] - gravity * load * 9.81 * length * s - 0.01 * v[1]
    det = m11 * m22 - m12**2
    return np.stack([(m22 * b1 - m12 * b2) / det, (m11 * b2 - m12 * b1) / det])


def _arm(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    a, b, d = 1.6, 0.5, 0.5
    s, c = np.sin(q[1]), np.cos(q[1])
    m11, m12, m22 = a + 2 * b * c, d + b * c, d + 0 * c
    g2 = gravity * 3.0 * np.sin(q[0] + q[1])
    b1 = forces[0] + b * s * (2 * v[0] * v[1] + v[1] ** 2) - gravity * 8.0 * np.sin(q[0]) - g2 - 0.2 * v[0]
    b2 = forces[1] - b * s * v[0] ** 2 - g2 - 0.2 * v[1]
    det = m11 * m22 - m12**2
    return np.stack([(m22 * b1 - m12 * b2) / det, (m11 * b2 - m12 * b1) / det])


def _quadrotor(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    """A planar quadrotor: x, z and tilt; thrust beyond hovering and torque."""
    thrust = 9.81 + forces[1]
    return np.stack(
        [
            forces[0] - thrust * np.sin(q[2]) - 0.1 * v[0],
            thrust * np.cos(q[2]) - gravity * 9.81 - 0.1 * v[1],
            forces[2] / 0.2 - 0.1 * v[2],
        ]
    )


def _followed(p: Parameters, names: tuple[str, ...], horizon: int, dt: float, width: int) -> Task:
    """Return the task of following a path of some joints, each to a goal and with a wave; the others are at 0."""
    goals = np.stack([p[name] for name in names], axis=-1)
    positions, rates = [], []
    for i in range(width):
        goal = goals[..., i] if i < len(names) else np.zeros(goals.shape[:-1])
        q, v = path(
            horizon,
            dt,
            0.0 * goal,
            goal,
            0.3 * np.abs(goals).max(axis=-1) * (i < len(names)),
            p.frequency * (1 + 0.3 * i),
        )
        positions.append(q)
        rates.append(v)
    reference = np.stack([*positions, *rates], axis=-1)
    return Task(reference[..., 0, :], reference=reference, horizon=horizon, dt=dt)


def _tracking(
    gains: tuple[Any, Any], names: tuple[str, ...], reach: float, frequency: tuple[float, float], units: str,
    horizon: int, width: int, compared: tuple[int, ...], followed: tuple[int, ...],
) -> Callable[[Robot, Any], Experiment]:  # fmt: skip
    def make(robot: Robot, system: Any) -> Experiment:
        return experiment(
            robot.name,
            units,
            space=TaskSpace(**dict.fromkeys(names, (-reach, reach, units)), frequency=(*frequency, "Hz")),
            task=lambda p: _followed(p, names, horizon, robot.dt, width),
            system=system,
            model=robot.model,
            synthesizer=controllers.PID(gains[0], 0.0, gains[1], components=followed),
            distance=distances.MaximumDeviation(components=compared),
            start_tolerance=1e6,
        )

    return make


def _regulated(
    weights: tuple[Any, Any], space: Callable[[], TaskSpace], ends: Callable[[Parameters], tuple[list[Any], list[Any]]],
    units: str, horizon: int, compared: tuple[int, ...],
) -> Callable[[Robot, Any], Experiment]:  # fmt: skip
    def make(robot: Robot, system: Any) -> Experiment:
        def task(p: Parameters) -> Task:
            start, goal = ends(p)
            return Task(start, goal=goal, horizon=horizon, dt=robot.dt)

        return experiment(
            robot.name,
            units,
            space=space(),
            task=task,
            system=system,
            model=robot.model,
            synthesizer=controllers.LQR(*weights),
            distance=distances.MaximumDeviation(components=compared),
            start_tolerance=1e6,
        )

    return make


def _of_gymnasium(name: str) -> Path:
    import gymnasium

    return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / name


def _analytic(
    name: str, joints: int, driven: tuple[int, ...], acceleration: Acceleration, dt: float, **more: Any
) -> Robot:
    model = _analytic_model(joints, driven, acceleration, dt)
    return Robot(name, joints, len(driven), driven, dt, model=model, acceleration=acceleration, **more)


def _pusher(robot: Robot, system: Any) -> Experiment:
    made = _tracking(
        ([20.0, 20.0, 3.0, 10.0, 1.0, 2.0, 1.0], [4.0, 4.0, 0.3, 2.0, 0.1, 0.2, 0.1]),
        ("pan", "lift", "roll", "elbow"), 0.5, (0.2, 0.6), "rad", 100, 11, (0, 1, 2, 3), (0, 1, 2, 3, 4, 5, 6),
    )  # fmt: skip
    return made(robot, system)


DEVELOPMENT = {
    each.name: each
    for each in (
        _analytic(
            "pendulum", 1, (0,), _pendulum, 0.02,
            rates=(1.0,), efforts=(4.0,), weights=(0,),
            make=_tracking((30.0, 5.0), ("goal",), 1.2, (0.3, 0.8), "rad", 120, 1, (0,), (0,)),
        ),
        _analytic(
            "crane", 2, (0,), _crane, 0.04,
            rates=(1.0, 1.0), efforts=(3.0,), weights=(1,),
            make=_tracking((6.0, 5.0), ("goal",), 1.2, (0.2, 0.5), "m", 100, 2, (0, 1), (0,)),
        ),
        Robot(
            "double pendulum", 3, 1, (0,), 0.02, (1.0, 1.0, 1.0), (0.2,),
            models.MuJoCo(_of_gymnasium("inverted_double_pendulum.xml"), dt=0.02),
            _regulated(
                ([10.0, 20.0, 20.0, 1.0, 1.0, 1.0], [400.0]),
                lambda: TaskSpace(goal=(-0.5, 0.5, "m"), first=(-0.1, 0.1, "rad"), second=(-0.1, 0.1, "rad")),
                lambda p: ([0.0, p.first, p.second, 0.0, 0.0, 0.0], [p.goal, 0.0, 0.0, 0.0, 0.0, 0.0]),
                "m", 120, (0, 1, 2),
            ),
            mjcf=_of_gymnasium("inverted_double_pendulum.xml"), joint_efforts=(10.0, 3.0, 1.0),
        ),
    )
}  # fmt: skip

REPORTING = {
    each.name: each
    for each in (
        _analytic(
            "arm", 2, (0, 1), _arm, 0.02,
            rates=(1.0, 1.0), efforts=(8.0, 3.0), weights=(0, 1),
            make=_tracking(
                ([80.0, 40.0], [20.0, 8.0]), ("first", "second"), 1.0, (0.2, 0.7), "rad", 120, 2, (0, 1), (0, 1)
            ),
        ),
        _analytic(
            "quadrotor", 3, (1, 2), _quadrotor, 0.04,
            rates=(1.0, 1.0, 1.0), efforts=(2.0, 0.3), weights=(1,),
            make=_regulated(
                ([4.0, 6.0, 2.0, 2.0, 2.0, 0.5], [0.5, 5.0]),
                lambda: TaskSpace(x=(-1.5, 1.5, "m"), z=(-1.0, 1.0, "m"), tilt=(-0.2, 0.2, "rad")),
                lambda p: ([0.0, 0.0, p.tilt, 0.0, 0.0, 0.0], [p.x, p.z, 0.0, 0.0, 0.0, 0.0]),
                "m", 100, (0, 1, 2),
            ),
        ),
        Robot(
            "pusher", 7, 7, (0, 1, 2, 3, 4, 5, 6), 0.02, (1.0,) * 7, (1.5, 1.5, 0.5, 0.8, 0.2, 0.2, 0.2),
            models.MuJoCo(_of_gymnasium("pusher_v5.xml"), dt=0.02), _pusher,
            mjcf=_of_gymnasium("pusher_v5.xml"), joint_efforts=(1.5, 1.5, 0.5, 0.8, 0.2, 0.2, 0.2),
        ),
    )
}  # fmt: skip


def _force_of(robot: Robot, joint: int) -> float:
    """Return a typical force on a joint."""
    if robot.joint_efforts:
        return robot.joint_efforts[joint]
    return robot.efforts[robot.driven.index(joint)] if joint in robot.driven else 0.2


def faults_of(robot: Robot, count: int = 10) -> list[Fault]:
    """Return seeded faults of a robot of different kinds; the place and the sizes are random."""
    rng = np.random.default_rng(sum(map(ord, robot.name)))
    joints = [j for j in range(robot.joints) if robot.mjcf is None or j < 4]
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
    joints = [j for j in range(robot.joints) if j in robot.driven and (robot.mjcf is None or j < 4)]
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
