"""What a cause of a model's error is, what it acts on, and a model with causes in it.

A robot is its sensors around its mechanics around its actuators. A cause changes one of the three: the inputs that act
for those that are commanded, the next state, or what is recorded of a state.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller
from ctxval.core.model import Model, paired
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.models import MuJoCo
from ctxval.studies.causes.flow import Flow, Linearisation


@dataclass(frozen=True)
class Joint(ShortRepr):
    """A rate that forces change, and where the forces enter."""

    rate: int  #: index of the state
    position: int | None = None  #: index of the state whose derivative it is; None if no state is
    share: float = 0.5  #: weight of the rate at the end of a step in the change of the position; 0.5 is exact
    input: int | None = None  #: index of the input that drives the joint; None if no input does
    dof: int | None = None  #: index of the degree of freedom of a MuJoCo model; None for other models


@dataclass(frozen=True, eq=False)
class Plant(ShortRepr):
    """What sentences, sizes and forces need to know of a model."""

    model: Model
    dt: float
    states: list[tuple[str, str]]  #: names and units
    inputs: list[tuple[str, str]]
    joints: tuple[Joint, ...]  #: one for each rate of a position; if no state is a position, one for each state
    ports: tuple[Joint, ...]  #: where forces on joints may enter; a joint may have several
    changes: Array  #: typical changes of the states in a step, shape ``(n,)``
    commanded: Array  #: largest magnitudes of the inputs, shape ``(m,)``

    @property
    def compiled(self) -> Any:
        """The ``mujoco.MjModel`` of M; None if M is no model of MuJoCo."""
        return getattr(self.model, "compiled", None)

    def joint_name(self, joint: Joint) -> str:
        """Return the name of a joint: that of MuJoCo, or of its position, or of its rate."""
        if joint.dof is not None:
            number = int(self.compiled.dof_jntid[joint.dof])
            return str(self.compiled.joint(number).name) or f"joint {number + 1}"
        return self.states[joint.rate if joint.position is None else joint.position][0]

    def force_unit(self, joint: Joint) -> str:
        """Return the unit in which forces on a joint are counted."""
        if joint.dof is not None:
            return "N m" if self.compiled.jnt_type[self.compiled.dof_jntid[joint.dof]] == 3 else "N"
        if joint.input is not None:
            name, unit = self.inputs[joint.input]
            return unit or f"of {name}"
        unit = self.states[joint.rate][1]
        return f"{unit.removesuffix('/s')}/s^2" if unit.endswith("/s") else f"{unit}/s" if unit else "per s"

    def rate_unit(self, joint: Joint) -> str:
        """Return the unit of a joint's rate."""
        if joint.dof is not None and not self.states[joint.rate][1]:
            return "rad/s" if self.force_unit(joint) == "N m" else "m/s"
        return self.states[joint.rate][1]


def plant_of(model: Model, dt: float, states: dict[str, str], inputs: dict[str, str], x: Array, u: Array) -> Plant:
    """Return the plant of a model from states ``(N, n)`` and inputs ``(N, m)`` of closed loops."""
    with np.errstate(all="ignore"):
        reached = np.asarray(model.step(x, u))
    usable = np.isfinite(reached).all(axis=1)
    x, u, reached = x[usable], u[usable], reached[usable]
    changes = np.sqrt(((reached - x) ** 2).mean(axis=0))
    commanded = np.maximum(np.abs(u).max(axis=0, initial=0.0), 1e-9)
    if isinstance(model, MuJoCo):
        compiled = model.compiled
        driven = {compiled.actuator_trnid[k, 0]: k for k in range(compiled.nu) if compiled.actuator_trntype[k] == 0}
        joints = ports = tuple(
            Joint(compiled.nq + dof, position, 1.0, driven.get(number), dof)
            for number, (kind, position, dof) in enumerate(
                zip(compiled.jnt_type, compiled.jnt_qposadr.tolist(), compiled.jnt_dofadr.tolist(), strict=True)
            )
            if kind in (2, 3)  # slides and hinges
        )
    else:
        joints = _joints(dt, x, Flow.of(model, x, u).d / dt)
        ports = tuple(_ports(model, x, u, reached, commanded, joints))
    names = list(states.items()), list(inputs.items())
    return Plant(model, dt, *names, joints, ports, np.maximum(changes, 1e-12), commanded)


def _joints(dt: float, x: Array, change: Array) -> tuple[Joint, ...]:
    """Return the rates, each with the position whose derivative it is; each state is a rate if none is a position.

    The derivatives ``change`` are those at the states x, both ``(N, n)``.
    """
    pairs: dict[int, tuple[int, float]] = {}
    for position in range(x.shape[1]):
        size = float((change[:, position] ** 2).mean())
        errors = []
        for rate in range(x.shape[1]):
            left, gained = change[:, position] - x[:, rate], dt * change[:, rate]
            share = float(np.clip(left @ gained / max(float(gained @ gained), 1e-300), -0.5, 0.5))
            errors.append((float(((left - share * gained) ** 2).mean()), rate, 0.5 + share))
        error, rate, share = min(errors)
        if rate != position and size > 0 and error < 0.05**2 * size:
            pairs[rate] = position, share
    positions = {position for position, _ in pairs.values()}
    rates = [i for i in range(x.shape[1]) if i not in positions]
    return tuple(Joint(i, *pairs[i]) for i in rates if i in pairs) or tuple(map(Joint, rates))


def _ports(model: Model, x: Array, u: Array, reached: Array, commanded: Array, joints: Sequence[Joint]) -> list[Joint]:
    """Return the places where forces may enter: at the inputs that move a joint, and as accelerations of joints.

    An input may be the force on any joint that it moves, because other joints move with it. A joint that one input
    moves alone, and everywhere alike, has no other place.
    """
    m, rates = u.shape[1], [joint.rate for joint in joints]
    ports, alone = list[Joint](), set[int]()
    for k in range(m):
        moved = u.copy()
        moved[:, k] += 0.1 * commanded[k]
        effects = (np.asarray(model.step(x, moved)) - reached)[:, rates]
        sizes = np.sqrt((effects**2).mean(axis=0))
        largest = float(sizes.max(initial=0.0))
        for j, joint in enumerate(joints):
            if largest > 0 and sizes[j] > 0.2 * largest:
                ports.append(replace(joint, input=k))
                if np.delete(sizes, j).max(initial=0.0) < 0.01 * sizes[j] and effects[:, j].std() < 0.01 * sizes[j]:
                    alone.add(joint.rate)
    if m < len(joints):
        ports += [joint for joint in joints if joint.rate not in alone]
    return ports


@dataclass(frozen=True)
class Cause(ShortRepr):
    """Something that a model lacks, with sizes in physical units. A subclass changes one of the hooks, for batches."""

    sizes: tuple[float, ...]
    name: ClassVar[str]  #: what it is in two or three words
    remembers: ClassVar[bool] = False  #: whether inputs that act depend on earlier ones, so that no step has it

    def with_sizes(self, sizes: Sequence[float]) -> Cause:
        """Return the cause with other sizes."""
        return replace(self, sizes=tuple(float(size) for size in sizes))

    @property
    def kind(self) -> Cause:
        """The cause without its sizes: two causes of one kind are one cause."""
        return replace(self, sizes=())

    def model(self, model: Model) -> Model:
        """Return the model of the mechanics."""
        return model

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        """Return the inputs that act ``(..., m)`` for those of causes before, and a memory; None at the first step.

        If they change while a step goes on, they are those of its parts ``(..., parts, m)``.
        """
        return u, memory

    def duration(self, model: Model) -> float:
        """Return the steps of a model of the mechanics that a step of the system takes."""
        return 1.0

    def within(self, flow: Flow) -> Flow:
        """Return the flow of a step for the flow without this cause."""
        return flow

    def seeing(self, controller: Controller) -> Controller:
        """Return a controller that sees what this cause lets it see of the records."""
        return controller

    def true(self, recorded: Array) -> Array:
        """Return the states ``(..., n)`` of which these are recorded."""
        return recorded

    def recorded(self, x: Array) -> Array:
        """Return what is recorded of states ``(..., n)``."""
        return x

    def gap(self, difference: Array) -> Array:
        """Return differences of recorded states ``(..., n)`` as they are to be compared."""
        return difference

    def text(self, plant: Plant) -> str:
        """Return what it is with its sizes and units: a clause without a full stop."""
        raise NotImplementedError

    def python(self) -> str:
        """Return the Python expression that makes it."""
        given = [f"{name}={value!r}" for name, value in vars(self).items() if name != "sizes"]
        sizes = f"({', '.join(f'{size:.6g}' for size in self.sizes)}{',' if len(self.sizes) == 1 else ''})"
        text = f"causes.{type(self).__name__}({', '.join([sizes, *given])})"
        return text.replace("Joint(rate", "causes.Joint(rate")

    def mjcf(self, plant: Plant) -> str | None:
        """Return the line of MJCF that puts it into a MuJoCo model; None if there is none."""
        return None


@dataclass(frozen=True)
class CauseCandidate(ShortRepr):
    """A cause whose sizes are to be fitted."""

    cause: Cause
    low: tuple[float, ...] = ()  #: bounds of the sizes
    high: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()  #: changes of the sizes that matter, for the steps of the fit
    starts: tuple[tuple[float, ...], ...] = ((),)  #: first guesses, of which the best one is refined


def of_size(cause: Cause, low: float, high: float, scale: float, *starts: float) -> CauseCandidate:
    """Return a candidate with one size."""
    return CauseCandidate(cause, (low,), (high,), (scale,), tuple((start,) for start in starts))


def of_ratio(cause: Cause) -> CauseCandidate:
    """Return a candidate whose size is a ratio."""
    return of_size(cause, 0.1, 10.0, 0.1, 0.95, 1.1)


@dataclass(frozen=True, eq=False)
class Repaired(ShortRepr):
    """A model with causes in it, which is also a system. Causes of the inputs act in their order, after the controller.

    A step of the model is a function of state and input, so it lacks causes that remember inputs, such as a delay;
    ``complete`` is False then. As a system, it has all causes.
    """

    given: Model
    causes: tuple[Cause, ...]

    batched: ClassVar[bool] = True

    @functools.cached_property
    def mechanics(self) -> Model:
        """M with what causes change in it."""
        return functools.reduce(lambda model, cause: cause.model(model), self.causes, self.given)

    @property
    def complete(self) -> bool:
        """Whether a step has all causes."""
        return not any(cause.remembers for cause in self.causes)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next recorded states ``(..., n)`` of recorded states; causes that remember are left out."""
        if x.ndim != u.ndim:
            x, u = map(np.array, paired(x, u))
        for cause in self.causes:
            u = u if cause.remembers else cause.follow(u, None)[0]
        return self.recorded(self.reached(self.true(x), u))

    def reached(self, x: Array, acting: Array, at: Linearisation | None = None) -> Array:
        """Return the next states ``(..., n)`` for the inputs that act; M may be linearised ``at`` states near x."""
        duration = math.prod(cause.duration(self.mechanics) for cause in self.causes)
        inside = [cause for cause in self.causes if type(cause).within is not Cause.within]
        with np.errstate(all="ignore"):
            while duration > 0:  # whole steps of M, and the rest of one
                if inside or duration < 1 or acting.ndim > x.ndim:
                    flow = Flow.of(self.mechanics, x, acting, at)
                    x = functools.reduce(lambda flow, cause: cause.within(flow), inside, flow).end(min(duration, 1.0))
                else:
                    x = np.asarray(self.mechanics.step(x, acting))
                duration, at = duration - 1, None
        return x

    def true(self, recorded: Array) -> Array:
        """Return the states ``(..., n)`` of which these are recorded."""
        for cause in reversed(self.causes):
            recorded = cause.true(recorded)
        return recorded

    def recorded(self, x: Array) -> Array:
        """Return what is recorded of states ``(..., n)``."""
        for cause in self.causes:
            x = cause.recorded(x)
        return x

    def acting(self, inputs: Array) -> Array:
        """Return the inputs that act in each step, for commanded ones ``(..., H, m)``; see :meth:`Cause.follow`."""
        acting = list(np.moveaxis(inputs, -2, 0))
        for cause in self.causes:
            memory = None
            for t, u in enumerate(acting):
                acting[t], memory = cause.follow(u, memory)
        return np.stack(acting, axis=inputs.ndim - 2)

    def execute(self, controller: Controller, task: Task, noise: Array | None = None) -> Trajectory:
        """Return the closed loop with all causes; the controller acts on what is recorded.

        Noise ``(H + 1, ..., n)`` is added to each recorded state; the initial state of the task has it already.
        """
        truth = self.true(np.asarray(task.initial_state, dtype=np.float64) - (0.0 if noise is None else noise[0]))
        memories: list[Any] = [None] * len(self.causes)
        added = iter(() if noise is None else noise[1:])

        def step(_: Array, u: Array) -> Array:
            nonlocal truth
            u = np.array(u)
            for k, cause in enumerate(self.causes):
                u, memories[k] = cause.follow(u, memories[k])
            truth = self.reached(truth, u)
            return self.recorded(truth) + next(added, 0.0)

        for cause in self.causes:
            controller = cause.seeing(controller)
        return rollout(step, controller, task)
