"""Robots in simulators, each with a model whose parameters are uncertain and with systems in this family and outside.

``ROBOTS`` is the table. S is M's simulator with other parameters: factors of those that are uncertain (inside), or also
what no parameter of M is (outside): armature, friction in joints, a slope, inputs that act late, another engine. Linear
policies are learned on M by random search in a few minutes (``python benchmarks/simulated_robots.py NAME``) and kept
in ``results/simulated_robots-policies.json``. Bodies are those of gymnasium, with steps of ``implicitfast`` in the
place of RK4 where this is named, and own ones. Go1 needs the package ``playground`` (its MJCF alone; a folder with it
may be named in the variable ``PLAYGROUND``) and its published policy in ``../shared/data/policies``.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Task, TaskSpace, Validation, controllers, distances, models, systems

POLICIES = Path(__file__).parent / "results" / "simulated_robots-policies.json"
Table = dict[str, float]


class MissingFileError(Exception):
    """A file that a robot needs is not there."""


@dataclass(frozen=True)
class Robot:
    """A robot: how its validation is made for a system, and the systems by name, as changes of M."""

    title: str
    make: Callable[[Table], Validation]
    inside: Table
    outside: dict[str, Table]
    tasks: int = 5_000  # random ones, from which the truth follows; stored ones of hopper and cheetah may have more
    tuned: bool = False  # whether rules of the source were changed after results on it

    @property
    def systems(self) -> dict[str, Table]:
        """The systems by name."""
        return {"inside": self.inside, **self.outside}


def changed(mjcf: str, dt: float, changes: Table, before: float | np.ndarray = 0.0) -> systems.Imperfect:
    """Return S: M with factors of parameters and with what no parameter of M is.

    Args:
        mjcf: of M.
        dt: length of a step, seconds.
        changes: factors of ``friction``, ``gain``, ``damping`` and ``armature`` of all elements and of ``mass NAME`` of
            a body; ``joint friction`` in N m and ``slope`` in m/s^2 are added; ``latency`` in steps.
        before: the inputs before the first one acts.
    """

    def change(model: Any) -> None:
        for name, value in changes.items():
            match name.split(" ", 1):
                case ["friction"]:
                    model.geom_friction[:, 0] *= value
                case ["gain"]:
                    model.actuator_gainprm[:, 0] *= value
                    model.actuator_biasprm[:, 1:3] *= value
                case ["damping"]:
                    model.dof_damping[:] *= value
                case ["armature"]:
                    model.dof_armature[:] *= value
                case ["mass", body]:
                    model.body(body).mass *= value
                    model.body(body).inertia *= value
                case ["joint", "friction"]:
                    hinges = model.jnt_dofadr[model.jnt_type >= 2]
                    driven = np.isin(model.dof_jntid[hinges], model.actuator_trnid[:, 0])
                    model.dof_frictionloss[hinges[driven]] += value
                case ["centre", body]:
                    model.body(body).ipos[0] += value
                case ["slope"]:
                    model.opt.gravity[0] += value
                case ["latency"]:
                    pass
                case _:
                    raise KeyError(name)

    model = models.MuJoCo(mjcf, dt=dt).changed(change)
    return systems.Imperfect(model, delay=changes.get("latency", 0.0), before=before)


# Robots of gymnasium with linear policies of the state, a clock and a commanded speed


@dataclass(frozen=True)
class Runner:
    """A body of gymnasium, its tasks, and what its policy sees."""

    file: str
    dt: float
    horizon: int
    positions: int  # number of qpos
    states: int
    inputs: int
    unseen: int  # number of qpos that the policy does not see
    period: float  # of the clock, in steps
    pitch: tuple[int, float]  # the state that differs at the start, and by how much at most
    speeds: tuple[float, float]
    start: Mapping[int, float] = field(default_factory=dict)  # states that are not 0
    upright: float = 0.0  # weight of the height in the reward
    fast: bool = False  # whether RK4 is replaced, with the double time step

    @functools.cached_property
    def mjcf(self) -> str:
        """The MJCF."""
        import gymnasium

        text = (Path(gymnasium.__file__).parent / "envs/mujoco/assets" / self.file).read_text()
        old, new = 'integrator="RK4" timestep="0.002"', 'integrator="implicitfast" timestep="0.004"'
        return text.replace(old, new).replace('integrator="RK4"', 'integrator="implicitfast"') if self.fast else text

    def states_of(self, pitch: Any, rate: Any) -> np.ndarray:
        """Return initial states ``(..., n)``."""
        x = np.zeros((*np.shape(pitch), self.states))
        x[..., list(self.start)] = list(self.start.values())
        x[..., self.pitch[0]] += pitch
        x[..., self.positions] = rate
        return x

    def task(self, p: Any) -> Task:
        """Return tasks."""
        x = self.states_of(p.points[..., 1], p.points[..., 2])
        return Task(x, command=p.points[..., :1], horizon=self.horizon, dt=self.dt)


@dataclass(frozen=True)
class Gait:
    """A linear policy of the state, a clock and the commanded speed."""

    runner: Runner
    weights: np.ndarray  # (m, F)
    command: np.ndarray  # (...)

    def __call__(self, t: int, x: np.ndarray) -> np.ndarray:
        """Return the inputs."""
        one, phase, nq = np.ones((*x.shape[:-1], 1)), 2 * np.pi * t / self.runner.period, self.runner.positions
        command = np.broadcast_to(self.command[..., None], one.shape)
        positions, rates = x[..., self.runner.unseen : nq], 0.2 * x[..., nq:]
        seen = [np.sin(phase) * one, np.cos(phase) * one, positions, rates, command, one]
        return np.tanh((self.weights @ np.concatenate(seen, axis=-1)[..., None])[..., 0])

    def __getitem__(self, index: Any) -> Gait:
        weights = self.weights if self.weights.ndim == 2 else self.weights[index]
        return Gait(self.runner, weights, self.command[index])


class Gaits:
    """Designs gaits with the same weights."""

    batched = True

    def __init__(self, runner: Runner, weights: np.ndarray) -> None:
        self.runner, self.weights = runner, weights

    def design(self, task: Task, model: object) -> Gait:
        """Return the gait with the speed of a task."""
        return Gait(self.runner, self.weights, np.asarray(task.command)[..., 0])


RUNNERS = {
    "cheetah": Runner("half_cheetah.xml", 0.05, 40, 9, 18, 6, 1, 9.0, (2, 0.2), (0.5, 2.5)),
    "hopper": Runner("hopper.xml", 0.02, 60, 6, 12, 3, 1, 25.0, (2, 0.05), (0.2, 0.8), {1: 1.25}, 2.0, True),
    "walker": Runner("walker2d_v5.xml", 0.02, 60, 9, 18, 6, 1, 30.0, (2, 0.05), (0.3, 1.0), {1: 1.25}, 2.0, True),
    "ant": Runner(
        "ant.xml", 0.05, 40, 15, 29, 8, 2, 10.0, (7, 0.2), (0.2, 1.0),
        {2: 0.55, 3: 1.0, 8: 1.0, 10: -1.0, 12: -1.0, 14: 1.0}, 0.0, True,
    ),
}  # fmt: skip


def train(name: str, seconds: float = 150.0) -> None:
    """Learn the policy of a runner by augmented random search on M (Mania et al. 2018), and keep the best one."""
    runner, rng = RUNNERS[name], np.random.default_rng(0)
    m, count = runner.inputs, runner.states - runner.unseen + 4
    system = systems.MuJoCo(runner.mjcf, substeps=round(runner.dt / models.MuJoCo(runner.mjcf).dt))
    weights, best, begun, rounds = np.zeros((m, count)), -np.inf, time.monotonic(), 0
    few = round(0.4 / runner.dt)

    def rewards(each: np.ndarray, command: np.ndarray) -> np.ndarray:
        largest = runner.pitch[1]
        x = runner.states_of(rng.uniform(-largest, largest, len(each)), rng.uniform(-0.2, 0.2, len(each)))
        task = Task(x, horizon=round(1.5 * runner.horizon), dt=runner.dt)
        run = system.execute(Gait(runner, each, command), task).states
        speed = (run[:, few:, 0] - run[:, :-few, 0]) / (few * runner.dt)
        lost = np.minimum(np.abs(speed - command[:, None]), 4.0).mean(axis=1)
        if name == "ant":
            lost += 0.5 * np.abs(run[..., 1]).mean(axis=1) + 0.3 * np.abs(run[..., 6]).mean(axis=1)
        else:
            lost += 0.5 * np.abs(run[..., 2]).mean(axis=1)
        if runner.upright:  # lower than 0.8 of the height at the start is a fall
            lost += runner.upright * (run[..., 1] < 0.8 * run[:, :1, 1]).mean(axis=1)
        return np.nan_to_num(-lost, nan=-50.0)

    commands = np.linspace(*runner.speeds, 16)
    while time.monotonic() - begun < seconds:
        moves, command = rng.normal(size=(20, m, count)), np.tile(rng.uniform(*runner.speeds, 20), 2)
        up, down = np.split(rewards(np.concatenate([weights + 0.12 * moves, weights - 0.12 * moves]), command), 2)
        top = np.argsort(-np.maximum(up, down))[:12]
        scale = np.concatenate([up[top], down[top]]).std() + 1e-6
        weights = weights + 0.06 * ((up - down)[top, None, None] * moves[top]).mean(axis=0) / scale
        rounds += 1
        if rounds % 20 == 0 and (reached := rewards(np.tile(weights, (16, 1, 1)), commands).mean()) > best:
            best = reached
            kept = json.loads(POLICIES.read_text()) if POLICIES.exists() else {}
            kept[name] = {"reward": float(best), "weights": weights.round(6).tolist()}
            POLICIES.write_text(json.dumps(kept) + "\n")
    print(f"{name}: reward {best:.3f} after {rounds} rounds")


def running(name: str, uncertain: Mapping[str, float | str]) -> Callable[[Table], Validation]:
    """Return what makes the validations of a runner."""

    def make(changes: Table) -> Validation:
        runner = RUNNERS[name]
        largest = runner.pitch[1]
        weights = np.array(json.loads(POLICIES.read_text())[name]["weights"])
        rate = (-1.0, 1.0, "m/s") if name == "cheetah" else (-0.2, 0.2, "m/s")
        return Validation(
            space=TaskSpace(speed=(*runner.speeds, "m/s"), pitch=(-largest, largest, "rad"), start=rate),
            task=runner.task,
            system=changed(runner.mjcf, runner.dt, changes),
            model=models.MuJoCo(runner.mjcf, dt=runner.dt, uncertain=uncertain),
            synthesizer=Gaits(runner, weights),
            distance=distances.MaximumDeviation(components=[0, 1] if name == "ant" else [0]),
        )

    return make


# A drone in a plane, with a cascaded controller that integrates errors of position

STEP, GRAVITY = 0.02, 9.81
NOMINAL = {"mass": 1.0, "inertia": 1.0, "drag": 0.0, "wind": 0.0}


def flown(x: np.ndarray, u: np.ndarray, theta: Any) -> np.ndarray:
    """Return the next states (x, z, tilt, rates) under a thrust over the weight and an angular acceleration."""
    mass, inertia, drag, wind = theta
    place, tilt, rate, spin = x[..., :2], x[..., 2], x[..., 3:5], x[..., 5]
    for _ in range(2):
        h = STEP / 2
        push = np.stack([np.sin(tilt), np.cos(tilt)], axis=-1) * u[..., :1] * GRAVITY
        air = rate - np.stack([wind + 0 * tilt, 0 * tilt], axis=-1)
        down = np.stack([0 * tilt, GRAVITY + 0 * tilt], axis=-1)
        rate = rate + h * (push / np.asarray(mass)[..., None] - down - np.maximum(drag, 0.0)[..., None] * air)
        spin = spin + h * u[..., 1] / inertia
        place, tilt = place + h * rate, tilt + h * spin
    return np.concatenate([place, tilt[..., None], rate, spin[..., None]], axis=-1)


@dataclass(frozen=True)
class Cascade:
    """Position, tilt and their rates, with an integral of the position's error."""

    goal: np.ndarray

    def start(self, task: Task) -> np.ndarray:
        """Return the integral at the start."""
        return np.zeros((*task.batch_shape, 2))

    def step(self, t: int, x: np.ndarray, integral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return thrust and angular acceleration, and the integral."""
        error = np.clip(self.goal - x[..., :2], -1.0, 1.0)
        integral = np.clip(integral + STEP * error, -0.5, 0.5)
        wanted = np.clip(5 * error + 1.5 * integral - 3.5 * x[..., 3:5], -5, 5)
        tilt = np.clip(wanted[..., 0] / GRAVITY, -0.5, 0.5)
        turn = np.clip(60 * (tilt - x[..., 2]) - 14 * x[..., 5], -60, 60)
        thrust = np.clip((1 + wanted[..., 1] / GRAVITY) / np.cos(np.clip(x[..., 2], -0.8, 0.8)), 0.2, 2.0)
        return np.stack([thrust, turn], axis=-1), integral

    def __getitem__(self, index: Any) -> Cascade:
        return Cascade(self.goal[index])


class Cascades:
    """Designs cascades."""

    batched = True

    def design(self, task: Task, model: object) -> Cascade:
        """Return the cascade towards the goal of a task."""
        return Cascade(np.asarray(task.goal)[..., :2])


def drone(changes: Table) -> Validation:
    """Return the validation of the drone."""
    others = {name: value for name, value in changes.items() if name != "latency"}
    truth = models.Parametric(flown, NOMINAL | others, vectorized=True)
    uncertain: dict[str, float | str] = {"mass": "15 %", "inertia": "15 %", "drag": 0.3, "wind": 1.0}

    def task(p: Any) -> Task:
        x = np.zeros((*p.points.shape[:-1], 6))
        x[..., 3] = p.points[..., 2]
        goal = np.concatenate([p.points[..., :2], np.zeros_like(x[..., :4])], axis=-1)
        return Task(x, goal=goal, horizon=125, dt=STEP)

    return Validation(
        space=TaskSpace(x=(-2.0, 2.0, "m"), z=(-1.0, 1.0, "m"), rate=(-1.0, 1.0, "m/s")),
        task=task,
        system=systems.Imperfect(truth, lag=changes.get("latency", 0.0)),
        model=models.Parametric(flown, NOMINAL, uncertain=uncertain, vectorized=True),
        synthesizer=Cascades(),
        distance=distances.MaximumDeviation(components=[0, 1]),
    )


# An arm in a vertical plane that reaches with a payload

PERIOD = 0.01  # seconds


def arm_mjcf(hand: float = 1.0, damping: float = 1.0, armature: float = 0.01) -> str:
    """Return two links with a payload of 0.4 kg at the hand, and factors of its mass and of the damping."""
    return f"""<mujoco><option timestep="0.002" integrator="implicitfast"/>
<default><joint axis="0 1 0" damping="{0.3 * damping:.6g}" armature="{armature:.6g}"/>
<geom contype="0" conaffinity="0"/></default>
<worldbody><body name="upper" pos="0 0 1"><joint name="shoulder"/>
<geom type="capsule" size=".03" fromto="0 0 0 .4 0 0" mass="1"/>
<body name="lower" pos=".4 0 0"><joint name="elbow"/>
<geom type="capsule" size=".025" fromto="0 0 0 .35 0 0" mass=".6"/>
<body name="hand" pos=".35 0 0"><geom type="sphere" size=".03" mass="{0.4 * hand:.6g}"/></body></body></body>
</worldbody>
<actuator><motor joint="shoulder" ctrlrange="-25 25"/><motor joint="elbow" ctrlrange="-15 15"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Servo:
    """Feedback of angles with an integral, and the weights of M's links."""

    goal: np.ndarray

    def start(self, task: Task) -> np.ndarray:
        """Return the integral at the start."""
        return np.zeros((*task.batch_shape, 2))

    def step(self, t: int, x: np.ndarray, integral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return torques and the integral."""
        error, rate = self.goal - x[..., :2], x[..., 2:]
        integral = np.clip(integral + PERIOD * error, -0.3, 0.3)
        first, both = np.cos(x[..., 0]), np.cos(x[..., 0] + x[..., 1])
        lower = 9.81 * (0.6 * 0.175 + 0.4 * 0.35) * both
        upper = 9.81 * (1.0 * 0.2 + 1.0 * 0.4) * first
        weight = -np.stack([upper + lower, lower], axis=-1)
        feedback = np.array([50.0, 15.0]) * error + np.array([40.0, 12.0]) * integral - np.array([7.0, 1.5]) * rate
        return feedback + weight, integral

    def __getitem__(self, index: Any) -> Servo:
        return Servo(self.goal[index])


class Servos:
    """Designs servos."""

    batched = True

    def design(self, task: Task, model: object) -> Servo:
        """Return the servo towards the angles of a task."""
        return Servo(np.asarray(task.goal)[..., :2])


def reaching(mjcf: str, system: Any) -> Validation:
    """Return the validation of the arm with an MJCF and a system."""

    def task(p: Any) -> Task:
        x = np.zeros((*p.points.shape[:-1], 4))
        x[..., :2] = p.points[..., 2:]
        goal = np.concatenate([p.points[..., :2], np.zeros_like(x[..., :2])], axis=-1)
        return Task(x, goal=goal, horizon=100, dt=PERIOD)

    uncertain: dict[str, float | str] = {"mass[hand]": "30 %", "damping": "30 %", "gain": "10 %"}
    angles = {"shoulder": (-1.0, 0.6, "rad"), "elbow": (-1.2, 0.6, "rad")}
    return Validation(
        space=TaskSpace(**angles, **{f"{name} at start": (-0.4, 0.4, "rad") for name in angles}),
        task=task,
        system=system,
        model=models.MuJoCo(mjcf, dt=PERIOD, uncertain=uncertain),
        synthesizer=Servos(),
        distance=distances.MaximumDeviation(components=[0, 1]),
    )


def arm(changes: Table) -> Validation:
    """Return the validation of the arm in MuJoCo."""
    return reaching(arm_mjcf(), changed(arm_mjcf(), PERIOD, changes))


def bullet(changes: Table) -> Validation:
    """Return the validation of the arm without armature in PyBullet; M is the arm in MuJoCo."""
    if importlib.util.find_spec("pybullet") is None:
        raise MissingFileError("the package pybullet is not installed")
    return reaching(arm_mjcf(armature=0.0), systems.PyBullet(arm_mjcf(armature=0.0, **changes), substeps=5))


# A finger that pushes a box over a table

PUSHED = """<mujoco><option timestep="0.004" cone="elliptic" integrator="implicitfast" iterations="50"/>
<worldbody><geom name="table" type="plane" size="2 2 .1" friction=".4 .005 .0001"/>
<body name="box" pos="0 0 .03"><freejoint/>
<geom type="box" size=".05 .05 .03" mass=".3" friction=".4 .005 .0001"/></body>
<body name="finger" pos="-.12 0 .03"><joint name="x" type="slide" axis="1 0 0" damping="5"/>
<joint name="y" type="slide" axis="0 1 0" damping="5"/>
<geom type="sphere" size=".015" mass=".5" friction=".3 .005 .0001"/></body></worldbody>
<contact><exclude body1="finger" body2="world"/></contact>
<actuator><motor joint="x" ctrlrange="-20 20"/><motor joint="y" ctrlrange="-20 20"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Push:
    """A push with a speed at an offset, by feedback of the finger's velocity with an integral."""

    command: np.ndarray  # offset and speed (..., 2)

    def start(self, task: Task) -> np.ndarray:
        """Return the integral at the start."""
        return np.zeros((*task.batch_shape, 2))

    def step(self, t: int, x: np.ndarray, integral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return forces and the integral."""
        wanted = np.where(t < 45, self.command[..., 1], 0.0)
        side = 3 * (self.command[..., 0] - x[..., 8])
        error = np.stack([wanted - x[..., 15], side - x[..., 16]], axis=-1)
        integral = integral + STEP * error
        return 25 * error + 60 * integral, integral

    def __getitem__(self, index: Any) -> Push:
        return Push(self.command[index])


class Pushes:
    """Designs pushes."""

    batched = True

    def design(self, task: Task, model: object) -> Push:
        """Return the push of a task."""
        return Push(np.asarray(task.command))


def box(changes: Table) -> Validation:
    """Return the validation of the box."""

    def task(p: Any) -> Task:
        offset, _, angle = (p.points[..., k] for k in range(3))
        x = np.zeros((*offset.shape, 17))
        x[..., 2], x[..., 3], x[..., 6], x[..., 8] = 0.03, np.cos(angle / 2), np.sin(angle / 2), offset
        return Task(x, command=p.points[..., :2], horizon=60, dt=STEP)

    uncertain: dict[str, float | str] = {"friction": "20 %", "mass[box]": "20 %", "damping": "20 %"}
    return Validation(
        space=TaskSpace(offset=(-0.03, 0.03, "m"), speed=(0.1, 0.4, "m/s"), angle=(-0.3, 0.3, "rad")),
        task=task,
        system=changed(PUSHED, STEP, changes),
        model=models.MuJoCo(PUSHED, dt=STEP, uncertain=uncertain),
        synthesizer=Pushes(),
        distance=distances.FinalState(components=[0, 1], norm=2),
    )


# Go1 with a published policy

POSE = np.array((0.1, 0.9, -1.8, -0.1, 0.9, -1.8) * 2)
SHARED = Path(__file__).parents[2] / "shared" / "data" / "policies" / "go1_joystick.onnx"


@functools.cache
def go1_mjcf() -> str:
    """Return the MJCF of the package ``playground`` without meshes, on a floor."""
    import mujoco

    folder = os.environ.get("PLAYGROUND", "")
    found = importlib.util.find_spec("mujoco_playground")
    if not folder and (found is None or found.origin is None):
        raise MissingFileError(
            "the package playground is not installed, and PLAYGROUND names no folder with mujoco_playground"
        )
    package = Path(folder) / "mujoco_playground" if folder else Path(str(found and found.origin)).parent
    spec = mujoco.MjSpec.from_file(str(package / "_src/locomotion/go1/xmls/go1_mjx_feetonly.xml"))
    for geom in [each for each in spec.geoms if each.type == mujoco.mjtGeom.mjGEOM_MESH]:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    floor = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 0.01], "friction": [0.6, 0.005, 0.0001]}
    spec.worldbody.add_geom(name="floor", contype=1, conaffinity=0, priority=1, condim=3, **floor)
    spec.option.iterations, spec.option.ls_iterations = 20, 20
    spec.compile()
    return str(spec.to_xml())


def go1(changes: Table) -> Validation:
    """Return the validation of Go1, which walks with commanded velocities."""
    if not SHARED.exists():
        raise MissingFileError(f"the policy {SHARED.name} is not in {SHARED.parent}")
    mjcf, Term = go1_mjcf(), controllers.Term
    names = ("angular_velocity", "gravity", "joint_errors", "joint_rates", "last_action", "command")
    contract = controllers.PolicyContract(
        network=SHARED,
        observation=(Term("linear_velocity", at=(-0.01592, -0.06659, -0.00617)), *(Term(name) for name in names)),
        dt=STEP,
        joints=[f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")],
        default=POSE.tolist(),
        action=controllers.Action(scale=0.5),
    )

    def task(p: Any) -> Task:
        x = np.zeros((*p.points.shape[:-1], 37))
        x[..., 2], x[..., 3], x[..., 7:19] = 0.278, 1.0, POSE
        return Task(x, command=p.points, horizon=50, dt=STEP)

    return Validation(
        space=TaskSpace(forward=(-0.5, 1.0, "m/s"), sideways=(-0.4, 0.4, "m/s"), turn=(-0.7, 0.7, "rad/s")),
        task=task,
        system=changed(mjcf, STEP, changes, POSE),
        model=models.MuJoCo(mjcf, dt=STEP, uncertain={"friction": "20 %", "mass[trunk]": "15 %", "gain": "15 %"}),
        synthesizer=controllers.RobotPolicy(contract, mjcf=mjcf),
        distance=distances.MaximumDeviation(components=[0, 1]),
    )


LEGS = "[[bf]*]"  # joints whose names begin with b or f
ROBOTS = {
    "drone": Robot(
        "planar drone, cascade with integral", drone,
        {"mass": 1.12, "inertia": 1.05, "drag": 0.25, "wind": 0.8},
        {"lag of 2 steps": {"mass": 1.12, "inertia": 1.05, "drag": 0.25, "wind": 0.8, "latency": 2.0}}, tuned=True,
    ),
    "arm": Robot(
        "planar arm that reaches with a payload", arm,
        {"mass hand": 1.4, "damping": 1.3, "gain": 0.95},
        {
            "joint friction": {"mass hand": 1.4, "joint friction": 0.3},
            "latency": {"mass hand": 1.4, "latency": 1.5},
            "armature": {"mass hand": 1.4, "armature": 4.0},
        },
        tasks=2_000, tuned=True,
    ),
    "bullet": Robot(
        "the arm in PyBullet, M in MuJoCo", bullet, {"hand": 1.4, "damping": 1.3}, {"engine": {}}, tasks=2_000,
    ),
    "hopper": Robot(
        "Hopper, linear policy", running("hopper", {"friction": "20 %", "mass[torso]": "20 %", "gain": "20 %"}),
        {"friction": 0.8, "mass torso": 1.1, "gain": 0.95},
        {
            "armature": {"mass torso": 1.1, "armature": 1.2},
            "joint friction": {"mass torso": 1.1, "joint friction": 2.0},
            "slope": {"mass torso": 1.1, "slope": 0.3},
            "latency": {"mass torso": 1.1, "latency": 0.5},
        },
        tasks=2_000,
    ),
    "cheetah": Robot(
        "HalfCheetah, linear policy",
        running("cheetah", {
            "friction": "20 %", "mass[torso]": "20 %", f"damping{LEGS}": "20 %", "gain": "20 %",
            f"stiffness{LEGS}": "20 %",
        }),
        {"friction": 0.8, "gain": 0.92, "damping": 1.15},
        {
            "armature": {"friction": 0.8, "gain": 0.92, "armature": 1.3},
            "slope": {"friction": 0.9, "slope": 0.5},
            "latency": {"friction": 0.9, "latency": 0.5},
        },
        tasks=2_000, tuned=True,
    ),
    "walker": Robot(
        "Walker2d, linear policy", running("walker", {"friction": "20 %", "mass[torso]": "20 %", "gain": "20 %"}),
        {"friction": 0.8, "mass torso": 1.1, "gain": 0.95},
        {
            "joint friction": {"mass torso": 1.1, "joint friction": 2.0},
            "slope": {"mass torso": 1.1, "slope": 0.3},
            "latency": {"mass torso": 1.1, "latency": 0.5},
        },
        tasks=2_000,
    ),
    "ant": Robot(
        "Ant, linear policy", running("ant", {"friction": "20 %", "mass[torso]": "20 %", "gain": "20 %"}),
        {"friction": 0.8, "mass torso": 1.15, "gain": 0.92},
        {
            "armature": {"friction": 0.8, "armature": 1.3},
            "slope": {"friction": 0.8, "slope": 0.5},
        },
        tasks=2_000, tuned=True,
    ),
    "box": Robot(
        "finger that pushes a box", box, {"friction": 0.85, "mass box": 1.2},
        {"centre of mass": {"friction": 0.85, "centre box": 0.012}}, tasks=2_000, tuned=True,
    ),
    "go1": Robot(
        "Go1, published policy (37 states)", go1, {"friction": 0.8, "mass trunk": 1.15, "gain": 0.9},
        {
            "joint friction": {"mass trunk": 1.15, "joint friction": 0.3},
            "slope": {"mass trunk": 1.15, "slope": 0.5},
        },
        tasks=2_000, tuned=True,
    ),
}  # fmt: skip


if __name__ == "__main__":
    for each in sys.argv[1:] or RUNNERS:
        train(each)
