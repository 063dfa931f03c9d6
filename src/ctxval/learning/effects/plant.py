"""What effects need to know of a model: its joints, and where forces enter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.learning.effects.flow import Flow
from ctxval.models import MuJoCo


@dataclass(frozen=True)
class Joint(ShortRepr):
    """A rate that forces change, and where the forces enter."""

    rate: int  #: index of the state
    position: int | None = None  #: index of the state whose derivative it is; None if no state is
    share: float = 0.5  #: weight of the rate at the end of a step in the change of the position; 0.5 is exact
    input: int | None = None  #: index of the input that drives the joint; None if no input does
    dof: int | None = None  #: index of the degree of freedom of a MuJoCo model; None for other models


def accelerations(n: int, joints: Sequence[Joint], dt: float) -> Array:
    """Return the part ``(n, n)`` of derivatives that accelerations of joints make, as M integrates."""
    part = np.zeros((n, n))
    for joint in joints:
        part[joint.rate, joint.rate] = 1.0
        if joint.position is not None:
            part[joint.position, joint.rate] = (joint.share - 0.5) * dt
    return part


def drive(flow: Flow, joint: Joint, probe: float, dt: float) -> Array:
    """Return the change of the state ``(..., n)`` by one unit of a force on a joint in a step, in units of ``flow.d``.

    It is measured with a force of the size ``probe``.
    """
    model, x, u = flow.model, flow.start, flow.inputs
    if joint.dof is not None:  # of a model of MuJoCo
        forces = probe * np.eye(model.compiled.nv)[joint.dof]  # type: ignore[attr-defined]
        pushed = model.changed(forces=forces).step(x, u)  # type: ignore[attr-defined]
        return flow.driven((pushed - flow.reached) / probe)
    if joint.input is not None:
        moved = u + probe * np.eye(u.shape[-1])[joint.input]
        return flow.driven((np.asarray(model.step(x, moved)) - flow.reached) / probe)
    accelerated = accelerations(x.shape[-1], [joint], dt)[:, joint.rate]
    return np.broadcast_to(dt * accelerated, x.shape)


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
