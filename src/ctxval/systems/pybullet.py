"""A URDF or MJCF file in PyBullet as the true system."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.checked import PositiveInt, Seconds
from ctxval._util.mjcf import compile_mjcf, digest_of, is_mjcf_text
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.registry import part
from ctxval._util.urdf import Tree, touching, trees_of
from ctxval.core.controller import Controller
from ctxval.core.floating_base import in_body
from ctxval.core.task import Task
from ctxval.core.trajectory import TERMINATED, Trajectory
from ctxval.errors import InputError, ShapeError
from ctxval.systems.episode import require_one, require_started, run_episode

_FASTEST = 1e6  # rad/s, at which a simulation has become unstable; Bullet's own limit of joints, 100, is too low


@part(files=("file", "mjcf"))
class PyBullet:
    """A robot in PyBullet as the true system, with the states and inputs of :class:`ctxval.models.MuJoCo`.

    The state is ``(qpos, qvel)`` of MuJoCo: joints are found by name; a free joint has a quaternion with w first, the
    velocity of its body's origin in the world, and the angular velocity in the body frame. Inputs are ``ctrl``: gains,
    biases, gears and ranges of the actuators turn them into torques before each step of the engine. Inertias, limits,
    damping, dry friction and friction are those of the file; other damping of Bullet is 0.

    Contacts of Bullet are rigid, and the frictions of two links are multiplied, where MuJoCo takes the larger one.
    Bullet has no armature, and damping is explicit, so joints with both may need a smaller ``timestep``.

    Args:
        file: a URDF file, or an MJCF file or its text. MuJoCo compiles an MJCF, and Bullet gets it as a URDF.
        mjcf: the MJCF of M, for a URDF, which gets its joints, actuators, gravity, timestep and fixed geoms.
        timestep: of the engine, seconds; by default that of the MJCF.
        substeps: number of these in one control step.

    Raises:
        InputError: if a URDF has no MJCF, or an MJCF has one.
    """

    def __init__(
        self,
        file: str | Path,
        *,
        mjcf: str | Path | None = None,
        timestep: Seconds | None = None,
        substeps: PositiveInt = 1,
    ) -> None:
        require_extra("pybullet", "pybullet", "systems.PyBullet needs")
        is_urdf = not is_mjcf_text(file) and Path(file).suffix.lower() == ".urdf"
        if is_urdf == (mjcf is None):
            raise InputError("mjcf must be given for a URDF, and only for a URDF: an MJCF has its own joints.")
        self._urdf, self.substeps = Path(file).absolute() if is_urdf else None, substeps
        with reworded(f"the file {str(file)!r} cannot be read", InputError):
            self._described: dict[str, Any] = {"file": digest_of(file), "substeps": substeps}
        self._described["mjcf"], self._model = compile_mjcf(file if mjcf is None else mjcf)
        self._robot = _of_mjcf(self._model, named=is_urdf)
        self.timestep = timestep or float(self._model.opt.timestep)
        self._idle = [self._made()]  # each execution takes its own, so that threads do not share one

    @property
    def dt(self) -> float:
        """Length of a control step, seconds."""
        return self.timestep * self.substeps

    def describe(self) -> dict[str, Any]:
        return {**self._described, "timestep": self.timestep}

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        require_one(task)
        if not np.isclose(task.dt, self.dt, rtol=1e-9, atol=0):
            wanted = f"{self.timestep:g} s x {self.substeps} = {self.dt:g} s"
            raise InputError(f"the task's dt must be the timestep times substeps, {wanted}, got {task.dt:g} s.")
        robot = self._robot
        if task.initial_state.size != robot.states:
            wanted = f"{robot.states} states, {robot.nq} positions and {robot.states - robot.nq} velocities"
            raise ShapeError(f"the task must have {wanted}, got {task.initial_state.size}.")
        engine = self._idle.pop() if self._idle else self._made()
        engine.start(task.initial_state)

        def advance(u: Array) -> tuple[Array, str]:
            for _ in range(self.substeps):
                engine.step(u)
            x = engine.state()
            if np.abs(x).max() >= _FASTEST:
                return np.full_like(x, np.nan), f"{TERMINATED}: the simulation became unstable"
            return x, ""

        try:
            require_started(task, engine.state())
            return run_episode(advance, controller, task, robot.inputs)
        finally:
            self._idle.append(engine)

    def _made(self) -> _Engine:
        model = self._model
        engine = _Engine(self.timestep, model.opt.gravity)
        with tempfile.TemporaryDirectory() as folder:
            trees = (tree for tree in trees_of(model, Path(folder)) if self._urdf is None or tree.is_geom)
            for k, tree in enumerate(trees):
                path = Path(folder) / f"{k}.urdf"
                path.write_text(tree.urdf, encoding="ascii")
                engine.load(path, tree)
        if self._urdf is not None:
            engine.load(self._urdf, Tree("", fixed=not self._robot.free))
        engine.complete(self._robot, touching(model) if self._urdf is None else ())
        return engine

    def __getstate__(self) -> dict[str, Any]:
        # Engines cannot be pickled; another process makes its own.
        return {**vars(self), "_idle": []}


@dataclass(frozen=True)
class _Robot:
    """What states and inputs mean: joints of one degree of freedom by name, free joints, and actuators of joints."""

    names: tuple[str, ...]
    positions: Rows  #: of the joints in a state
    rates: Rows
    free: tuple[tuple[int, int], ...]  #: first position and first velocity of each free joint in a state
    nq: int
    zeros: Array  #: positions at which the joints of the engine are 0
    stiffness: Array  #: of springs of the joints, and where these are at rest
    rests: Array
    most: Array  #: largest torques of actuators on each joint
    driven: Rows  #: the joint of each actuator
    gear: Array
    gain: Array  #: by 1, length and velocity, shape ``(m, 3)``
    bias: Array
    ranges: Array  #: of inputs and of forces, shape ``(m, 2, 2)``

    @property
    def states(self) -> int:
        return self.nq + len(self.names) + 6 * len(self.free)

    @property
    def inputs(self) -> int:
        return len(self.driven)

    def torques(self, positions: Array, rates: Array, u: Array) -> Array:
        """Return the torques of actuators and springs on the joints, as MuJoCo computes them."""
        along = np.stack(
            [np.ones(self.inputs), self.gear * positions[self.driven], self.gear * rates[self.driven]], axis=-1
        )
        u = np.clip(u, *self.ranges[:, 0].T)
        forces = np.clip((self.gain * along).sum(axis=-1) * u + (self.bias * along).sum(axis=-1), *self.ranges[:, 1].T)
        torques = np.bincount(self.driven, self.gear * forces, minlength=len(self.names))
        return np.clip(torques, -self.most, self.most) - self.stiffness * (positions - self.rests)


def _of_mjcf(model: Any, named: bool) -> _Robot:
    """Return the states and inputs of a ``mujoco.MjModel``, of joints that a URDF names or of converted ones."""
    free, single = np.flatnonzero(model.jnt_type == 0), np.flatnonzero(model.jnt_type >= 2)
    places, dofs, acts = model.jnt_qposadr, model.jnt_dofadr, model.nu
    joints = model.actuator_trnid[:, 0]
    simple = (model.actuator_trntype <= 1) & (model.actuator_dyntype == 0) & np.isin(joints, single)
    simple &= (model.actuator_gaintype <= 1) & (model.actuator_biastype <= 1)
    if not simple.all():
        wrong = ", ".join(model.actuator(int(k)).name or str(k) for k in np.flatnonzero(~simple))
        raise InputError(f"actuators must be motors or servos of hinges and slides without states, got {wrong}.")
    affine = (model.actuator_gaintype == 1)[:, None] | (np.arange(3) == 0)
    limited = np.stack([model.actuator_ctrllimited, model.actuator_forcelimited], axis=-1).astype(bool)[..., None]
    ranges = np.stack([model.actuator_ctrlrange, model.actuator_forcerange], axis=1)
    names = tuple(model.joint(int(k)).name if named else f"j{k}" for k in single)
    return _Robot(
        names,
        places[single],
        model.nq + dofs[single],
        tuple((int(places[k]), int(model.nq + dofs[k])) for k in free),
        model.nq,
        zeros=np.zeros(len(single)) if named else model.qpos0[places[single]],
        stiffness=model.jnt_stiffness[single],
        rests=model.qpos_spring[places[single]],
        most=np.where(model.jnt_actfrclimited[single].astype(bool), model.jnt_actfrcrange[single, 1], np.inf),
        driven=np.searchsorted(single, joints),
        gear=model.actuator_gear[:, 0],
        gain=np.where(affine, model.actuator_gainprm[:, :3], 0.0),
        bias=np.where((model.actuator_biastype == 1)[:, None], model.actuator_biasprm[:, :3], 0.0),
        ranges=np.where(limited, ranges, np.broadcast_to([-np.inf, np.inf], (acts, 2, 2))),
    )


class _Engine:
    """One physics server with its bodies."""

    def __init__(self, timestep: float, gravity: Sequence[float]) -> None:
        self._bullet = require_extra("pybullet", "pybullet", "systems.PyBullet needs")
        self._client = self._bullet.connect(self._bullet.DIRECT)
        self._call("setGravity", *gravity)
        self._call("setTimeStep", timestep)
        self._call("setPhysicsEngineParameter", deterministicOverlappingPairs=1, enableFileCaching=0)
        self.joints: dict[str, tuple[int, Any]] = {}  #: the body and the information about each joint that moves
        self._links: dict[str, tuple[int, int]] = {}
        self._bases: list[int] = []  # of bodies that move freely

    def load(self, path: Path, tree: Tree) -> None:
        """Load a file at the place of a tree."""
        bullet, converted = self._bullet, tree.urdf != ""
        flags = bullet.URDF_USE_INERTIA_FROM_FILE
        flags |= (bullet.URDF_USE_SELF_COLLISION | bullet.URDF_USE_IMPLICIT_CYLINDER) if converted else 0
        with reworded(f"PyBullet cannot read {str(path)!r}", bullet.error):
            pose = tree.position.tolist(), np.roll(tree.quaternion, -1).tolist()
            body = self._call("loadURDF", str(path), *pose, useFixedBase=tree.fixed, flags=flags)
        self._call("changeDynamics", body, -1, linearDamping=0, angularDamping=0)
        self._links[self._call("getBodyInfo", body)[0].decode()] = body, -1
        for joint in range(self._call("getNumJoints", body)):
            info = self._call("getJointInfo", body, joint)
            self._links[info[12].decode()] = body, joint
            if info[2] == bullet.JOINT_FIXED:
                continue
            if info[2] not in (bullet.JOINT_REVOLUTE, bullet.JOINT_PRISMATIC):
                raise InputError(f"the joint {info[1].decode()} of {path} must be a hinge or a slide.")
            self.joints[info[1].decode()] = body, info
            self._call("changeDynamics", body, joint, jointDamping=info[6], maxJointVelocity=_FASTEST)
            # A motor that holds the joint with its dry friction.
            self._call("setJointMotorControl2", body, joint, bullet.VELOCITY_CONTROL, targetVelocity=0, force=info[7])
        if not tree.fixed:
            self._bases.append(body)

    def complete(self, robot: _Robot, touching: Iterable[tuple[str, str, bool]]) -> None:
        """Set which links may touch, and keep the state in which all simulations start."""
        self._robot = robot
        missing, unknown = set(robot.names) - set(self.joints), set(self.joints) - set(robot.names)
        if missing:
            raise InputError(
                f"the URDF lacks joints of the model: {', '.join(sorted(missing))}; it has {', '.join(self.joints)}."
            )
        if unknown:
            raise InputError(f"the model lacks joints of the URDF: {', '.join(sorted(unknown))}; make them fixed.")
        for one, other, let in touching:
            (a, i), (b, k) = self._links[one], self._links[other]
            self._call("setCollisionFilterPair", a, b, i, k, int(let))
        places = [(self.joints[name][0], int(self.joints[name][1][0])) for name in robot.names]
        self._groups = [
            (
                body,
                [link for b, link in places if b == body],
                np.array([k for k, (b, _) in enumerate(places) if b == body]),
            )
            for body in sorted({body for body, _ in places})
        ]
        # Bullet's pose of a base is that of its principal axes of inertia in its centre of mass.
        self._inertial = [self._call("getDynamicsInfo", body, -1)[3:5] for body in self._bases]
        self._turned: dict[int, Array] = {}  # the latest quaternions, w first, by their places in the state
        self._fresh = self._call("saveState")

    def start(self, x: Array) -> None:
        """Begin a simulation in a state ``(n,)``."""
        robot = self._robot
        self._call("restoreState", self._fresh)
        positions, rates = x[robot.positions] - robot.zeros, x[robot.rates]
        for body, joints, at in self._groups:
            for joint, q, v in zip(joints, positions[at], rates[at], strict=True):
                self._call("resetJointState", body, joint, q, v)
        for body, (place, turned), (q, v) in zip(self._bases, self._inertial, robot.free, strict=True):
            origin, quaternion = x[q : q + 3].tolist(), np.roll(x[q + 3 : q + 7], -1).tolist()
            self._turned[q] = x[q + 3 : q + 7]
            centre, axes = self._bullet.multiplyTransforms(origin, quaternion, place, turned)
            spin = self._bullet.rotateVector(quaternion, x[v + 3 : v + 6].tolist())
            velocity = x[v : v + 3] + np.cross(spin, np.subtract(centre, origin))
            self._call("resetBasePositionAndOrientation", body, centre, axes)
            self._call("resetBaseVelocity", body, velocity.tolist(), spin)

    def state(self) -> Array:
        """Return the state ``(n,)``."""
        robot, x = self._robot, np.empty(self._robot.states)
        x[robot.positions], x[robot.rates] = self._of_joints()
        for body, inertial, (q, v) in zip(self._bases, self._inertial, robot.free, strict=True):
            centre, axes = self._call("getBasePositionAndOrientation", body)
            velocity, spin = self._call("getBaseVelocity", body)
            back = self._bullet.invertTransform(*inertial)
            origin, quaternion = self._bullet.multiplyTransforms(centre, axes, *back)
            turned = np.roll(quaternion, 1)
            turned *= np.copysign(1.0, turned @ self._turned[q])  # of q and -q, the one that continues the motion
            x[q : q + 3], x[q + 3 : q + 7], self._turned[q] = origin, turned, turned
            x[v : v + 3] = np.add(velocity, np.cross(spin, np.subtract(origin, centre)))
            x[v + 3 : v + 6] = in_body(x[q + 3 : q + 7], np.array(spin))
        return x

    def step(self, u: Array) -> None:
        """Simulate one step of the engine."""
        torques = self._robot.torques(*self._of_joints(), u)
        for body, joints, at in self._groups:
            self._call(
                "setJointMotorControlArray", body, joints, self._bullet.TORQUE_CONTROL, forces=torques[at].tolist()
            )
        self._call("stepSimulation")

    def close(self) -> None:
        self._call("disconnect")

    def _of_joints(self) -> tuple[Array, Array]:
        """Return positions and rates of the joints in the order of the states."""
        values = np.empty((len(self._robot.names), 2))
        for body, joints, at in self._groups:
            values[at] = [each[:2] for each in self._call("getJointStates", body, joints)]
        return values[:, 0] + self._robot.zeros, values[:, 1]

    def _call(self, name: str, *args: Any, **options: Any) -> Any:
        return getattr(self._bullet, name)(*args, **options, physicsClientId=self._client)

    def __del__(self) -> None:
        with contextlib.suppress(Exception):  # the interpreter may be ending
            self.close()
