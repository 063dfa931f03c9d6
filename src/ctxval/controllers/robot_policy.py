"""A trained policy of a robot, as its contract describes it, on states of MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.mjcf import compile_mjcf
from ctxval._util.refusals import require_extra
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.controllers.policy_contract import PolicyContract, Term, clipped
from ctxval.controllers.policy_networks import read_network
from ctxval.core.controller import Limits
from ctxval.core.floating_base import FloatingBase
from ctxval.core.model import Model
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError


@dataclass(frozen=True, eq=False)
class JointLayout:
    """Where the states and inputs of a robot have the joints of its policy, in the order of the policy."""

    positions: Rows  #: indices of the positions of the joints
    rates: Rows  #: indices of their rates
    inputs: Rows  #: the joint that each input of the system drives
    velocity: int  #: index of the first velocity


def layout_of(compiled: Any, contract: PolicyContract) -> JointLayout:
    """Return the layout of a compiled ``mujoco.MjModel``; joints and actuators are found by their names."""
    mujoco = require_extra("mujoco", "mujoco", "models of MuJoCo need")
    kinds = [mujoco.mjtJoint(int(kind)).name for kind in compiled.jnt_type]
    free = [k for k, kind in enumerate(kinds) if kind == "mjJNT_FREE"]
    if (contract.base == "free") != (free[:1] == [0]):
        raise InputError(f"the MJCF must have a {contract.base} base, as the contract, as its first joint.")
    first = {"free": 1, "planar": 3, "fixed": 0}[contract.base]
    names = [compiled.joint(k).name for k in range(compiled.njnt)]
    chosen = [first + each if isinstance(each, int) else _index(names, each) for each in contract.joints]
    for each in chosen:
        if not first <= each < compiled.njnt or kinds[each] not in ("mjJNT_HINGE", "mjJNT_SLIDE"):
            raise InputError(f"joint {each} of the MJCF is no hinge or slide of {compiled.njnt} joints.")
    driven = list[int]()
    for actuator in range(compiled.nu if contract.action.target != "direct" else 0):
        joint = int(compiled.actuator_trnid[actuator, 0])
        of_joint = int(compiled.actuator_trntype[actuator]) == int(mujoco.mjtTrn.mjTRN_JOINT)
        if not of_joint or joint not in chosen:
            name = compiled.actuator(actuator).name or str(actuator)
            raise InputError(f"the actuator {name} of the MJCF drives no joint of the policy.")
        driven.append(chosen.index(joint))
    nq = int(compiled.nq)
    rates = nq + compiled.jnt_dofadr[chosen]
    return JointLayout(compiled.jnt_qposadr[chosen].astype(np.intp), rates.astype(np.intp), np.array(driven, int), nq)


def _index(names: Sequence[str], name: str) -> int:
    if name not in names:
        raise InputError(f"the MJCF has no joint {name!r}; it has {', '.join(names)}.")
    return names.index(name)


class PolicyMemory(NamedTuple):
    """What a policy remembers of earlier steps, each with the batch axes of the task in front."""

    action: Array  #: last output of the network ``(..., a)``
    seen: tuple[Array, ...]  #: values of each term with a history ``(..., h, k)``, and of whole observations
    states: tuple[Array, ...]  #: states of a recurrent network ``(..., k)``
    waiting: Array  #: outputs that act later ``(..., L, a)``, the next one first


@part(files=("contract", "mjcf"))
class RobotPolicy(ShortRepr):
    """A synthesizer that uses a trained policy for every task; the model is not used.

    States are those of MuJoCo, ``(qpos, qvel)``. Tasks have a ``command`` if the policy observes one. If the contract
    has the condition of a fall, robots lie still from their fall on in all distances.

    Args:
        contract: the contract, or its TOML file.
        mjcf: the MJCF of the robot, as text or a file, in which joints and actuators are found by their names. Without
            it, states and inputs must have the base first and then the joints in the order of the contract.

    Raises:
        InputError: if joints are not known.
        ShapeError: if the network does not fit the contract.
    """

    batched = True

    def __init__(self, contract: PolicyContract | str | Path, *, mjcf: str | Path | None = None) -> None:
        self.contract = contract if isinstance(contract, PolicyContract) else PolicyContract.read(contract)
        self.network = read_network(self.contract.network)
        self._layout: JointLayout | None = None
        self._digest = ""
        if mjcf is not None:
            self._digest, compiled = compile_mjcf(mjcf)
            self._layout = layout_of(compiled, self.contract)
        elif any(isinstance(each, int) for each in self.contract.joints):
            raise InputError("joints that are indices need the MJCF of the robot.")
        kind = "free" if self.contract.base == "fixed" else self.contract.base  # a fixed base has no term of the base
        self.base = FloatingBase(kind, velocity=None if self._layout is None else self._layout.velocity)
        self.fall = self.contract.fall(self.base)
        joints = len(self.contract.joints)
        self.actions = self.network.width or joints
        if joints and self.contract.action.target != "direct" and self.actions != joints:
            raise ShapeError(f"the network must return an action for each of {joints} joints, got {self.actions}.")
        if not self.actions:
            raise InputError("the contract must name the joints, because the network does not tell its actions.")
        self._require_width(None)

    def layout(self, states: int) -> JointLayout:
        """Return where states of a number have the joints.

        Raises:
            ShapeError: if the task has another number of states.
        """
        if self._layout is not None:
            return self._layout
        count, base = len(self.contract.joints), self.contract.base
        before, after = {"free": (7, 6), "planar": (3, 3), "fixed": (0, 0)}[base]
        velocity = (states + (base == "free")) // 2
        if self.contract.joints and states != before + after + 2 * count:
            wanted = f"{before + after + 2 * count} states, those of a {base} base and of {count} joints"
            raise ShapeError(f"the task must have {wanted}, got {states}; give the mjcf of the robot if it has more.")
        each = np.arange(count)
        return JointLayout(before + each, velocity + after + each, each, velocity)

    def design(self, task: Task, model: Model) -> PolicyController:
        if self.observes("command"):
            self._require_width(task.command.shape[-1])
        return PolicyController(self, task)

    def observes(self, name: str) -> bool:
        """Return whether the observation has a term of a name."""
        return any(each.term == name for each in self.contract.observation)

    def describe(self) -> dict[str, Any]:
        contract = {name: value for name, value in self.contract.to_table().items() if name != "network"}
        return {"contract": contract, "network": self.network.describe(), "mjcf": self._digest}

    def widths(self, command: int) -> list[tuple[str, int]]:
        """Return the terms of the observation and how many numbers each has, for a command of a length."""
        J, sizes = len(self.contract.joints), list[tuple[str, int]]()
        fixed = {"linear_velocity": 3, "angular_velocity": 3, "gravity": 3, "quaternion": 4, "height": 1}
        fixed |= dict.fromkeys(("joint_positions", "joint_errors", "joint_rates"), J)
        fixed |= {"last_action": self.actions, "command": command}
        for each in self.contract.observation:
            own = 2 * len(each.phases) if each.term == "clock" else len(each.values)
            sizes.append((each.term, each.history * self.contract.history * fixed.get(each.term, own)))
        return sizes

    def _require_width(self, command: int | None) -> None:
        """Refuse terms that have together another number of values than the network takes."""
        wanted, sizes = self.network.widths[0], self.widths(command or 0)
        total = sum(size for _, size in sizes)
        unknown = command is None and self.observes("command")
        if wanted is not None and (total > wanted if unknown else total != wanted):
            terms = ", ".join(f"{name} {size}" for name, size in sizes if not (unknown and name == "command"))
            raise ShapeError(f"the network takes {wanted} numbers, and the observation has {total}: {terms}.")


@dataclass(frozen=True, eq=False)
class PolicyController(ShortRepr):
    """The controller of a policy for one task or a batch; it computes in a batch what it computes of each row."""

    policy: RobotPolicy
    task: Task

    def start(self, task: Task) -> PolicyMemory:
        """Return the memory before the first step; refuse a time step that does not fit the contract.

        Raises:
            InputError: if dt or latency are no multiple of the task's dt.
        """
        contract, batch = self.policy.contract, task.batch_shape
        if not np.isclose(contract.dt, contract.decimation * task.dt, rtol=1e-6, atol=0):
            wanted = f"{contract.dt:g} s / {contract.decimation} = {contract.dt / contract.decimation:g} s"
            raise InputError(f"the task's dt must be that of the policy, {wanted}, got {task.dt:g} s.")
        late = contract.latency / task.dt
        if abs(late - round(late)) > 1e-6:
            wanted = f"a multiple of the task's dt, {task.dt:g} s"
            raise InputError(f"the latency of the policy must be {wanted}, got {contract.latency:g} s.")
        command = self.task.command.shape[-1] if self.policy.observes("command") else 0
        sizes = self.policy.widths(command)
        whole, seen = contract.history, list[Array]()
        for (_, size), term in zip(sizes, contract.observation, strict=True):
            if term.history > 1:
                seen.append(np.zeros((*batch, term.history, size // (term.history * whole))))
        if whole > 1:
            seen.append(np.zeros((*batch, whole, sum(size for _, size in sizes) // whole)))
        states = tuple(np.zeros((*batch, width or 0)) for width in self.policy.network.widths[1:])
        waiting = np.zeros((*batch, round(late), self.policy.actions))
        return PolicyMemory(np.zeros((*batch, self.policy.actions)), tuple(seen), states, waiting)

    def step(self, t: int, x: Array, memory: PolicyMemory) -> tuple[Array, PolicyMemory]:
        """Return the inputs ``(..., m)`` in states ``(..., n)`` at step t, and the new memory."""
        contract, action, seen, states, waiting = self.policy.contract, *memory
        if t % contract.decimation == 0:
            observation, seen = self._observed(t, x, action, seen)
            output, *new = self.policy.network.outputs(observation, *states)
            action, states = clipped(output, contract.action.clip), tuple(new)
        acting = action
        if waiting.shape[-2]:
            acting, waiting = waiting[..., 0, :], np.concatenate([waiting[..., 1:, :], action[..., None, :]], axis=-2)
        return self._inputs(x, acting), PolicyMemory(action, seen, states, waiting)

    def __getitem__(self, index: int) -> PolicyController:
        return PolicyController(self.policy, self.task[index])

    def _observed(self, t: int, x: Array, action: Array, seen: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Return the observations ``(..., k)`` at a step of the policy, and the histories with them."""
        contract, histories, parts = self.policy.contract, list(seen), list[Array]()
        kept, time = list[Array](), t // contract.decimation * contract.dt
        for term in contract.observation:
            value = term.of(self._value(term, time, x, action))
            if term.history > 1:
                kept.append(self._shifted(t, histories.pop(0), value))
                value = kept[-1].reshape(*value.shape[:-1], -1)
            parts.append(value)
        observation = np.concatenate(parts, axis=-1)
        if contract.clip is not None:
            observation = np.clip(observation, -contract.clip, contract.clip)
        if contract.history > 1:
            kept.append(self._shifted(t, histories.pop(0), observation))
            observation = kept[-1].reshape(*observation.shape[:-1], -1)
        return observation, tuple(kept)

    def _shifted(self, t: int, seen: Array, value: Array) -> Array:
        """Return a history ``(..., h, k)`` with the latest value ``(..., k)``."""
        latest = value[..., None, :]
        if t == 0 and self.policy.contract.history_start == "first":
            return np.repeat(latest, seen.shape[-2], axis=-2)
        if self.policy.contract.history_order == "newest first":
            return np.concatenate([latest, seen[..., :-1, :]], axis=-2)
        return np.concatenate([seen[..., 1:, :], latest], axis=-2)

    def _value(self, term: Term, time: float, x: Array, action: Array) -> Array:
        """Return the value ``(..., k)`` of a term, without its scale."""
        contract, base = self.policy.contract, self.policy.base
        match term.term:
            case "linear_velocity":
                return base.linear_velocity(x, term.at)
            case "angular_velocity":
                return base.angular_velocity(x)
            case "gravity":
                return base.gravity(x)
            case "quaternion":
                return base.quaternion(x)
            case "height":
                return base.height(x)[..., None]
            case "joint_positions":
                return np.asarray(x[..., self.policy.layout(x.shape[-1]).positions])
            case "joint_errors":
                return np.asarray(x[..., self.policy.layout(x.shape[-1]).positions] - np.asarray(contract.default))
            case "joint_rates":
                return np.asarray(x[..., self.policy.layout(x.shape[-1]).rates])
            case "states":
                return np.asarray(x[..., np.asarray(term.values, dtype=np.intp)])
            case "last_action":
                return action
            case "command":
                value = self.task.command
            case "clock":
                value = _clock(term, time)
            case _:
                value = np.asarray(term.values, dtype=np.float64)
        return np.broadcast_to(value, (*x.shape[:-1], value.shape[-1]))

    def _inputs(self, x: Array, action: Array) -> Array:
        """Return the inputs ``(..., m)`` of the system for outputs ``(..., a)`` of the network."""
        meaning, layout = self.policy.contract.action, self.policy.layout(x.shape[-1])
        u = np.asarray(meaning.scale) * action
        if meaning.target != "direct":
            u = u + np.asarray(self.policy.contract.default)
        if meaning.target == "torque":
            gap, rates = u - x[..., layout.positions], x[..., layout.rates]
            u = np.asarray(meaning.kp) * gap - np.asarray(meaning.kd) * rates
        if meaning.limits is not None:
            u = Limits.of(meaning.limits).clip(u)
        return u if meaning.target == "direct" else u[..., layout.inputs]


def _clock(term: Term, time: float) -> Array:
    phase = 2 * np.pi * (time / term.period + np.asarray(term.phases))
    waves = [np.sin(phase), np.cos(phase)]
    return np.concatenate(waves if term.order == "sin cos" else waves[::-1])
