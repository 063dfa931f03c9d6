"""``ctxval init --policy``: an experiment file for a trained policy and the MJCF of its robot."""

from __future__ import annotations

import os
from itertools import product
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import write_text
from ctxval._util.mjcf import compile_mjcf
from ctxval._util.texts import shell_word
from ctxval._util.toml import toml_text
from ctxval.controllers import Action, PolicyContract, RobotPolicy, Term, convert_policy
from ctxval.controllers.policy_descriptors import imu_of
from ctxval.controllers.policy_networks import PolicyNetwork, read_network
from ctxval.core.task import Task
from ctxval.distances import CommandError
from ctxval.errors import CtxvalError, InputError
from ctxval.models import MuJoCo as Model
from ctxval.models.mujoco import proposed_invariant
from ctxval.systems import MuJoCo

SECONDS = 3.0  # duration of the tasks that a drafted experiment has
PERIOD = 0.02  # period of a policy of a walking robot that no contract states, seconds
COMMANDS = {"vx": (0.0, 0.8, "m/s"), "vy": (-0.3, 0.3, "m/s"), "yaw_rate": (-0.5, 0.5, "rad/s")}


def write_experiment(file: Path, policy: Path, mjcf: Path, descriptor: Path | None) -> tuple[list[Path], str]:
    """Write an experiment file, and a contract if the policy is a network; return the files, and what was guessed."""
    written, guessed, given = [file], "", policy
    if policy.suffix == ".toml":
        contract = PolicyContract.read(policy)
    else:
        given = file.with_name(f"{file.stem}_policy.toml")
        if given.exists():
            raise InputError(f"{given} already exists and was not changed.")
        if descriptor is not None:
            contract = convert_policy(descriptor, policy, mjcf=mjcf)
        else:
            contract, guessed = drafted(policy, mjcf)
        written.append(given)
    made = RobotPolicy(contract, mjcf=mjcf)  # which refuses what does not fit
    text = _experiment(file, contract, made, given, mjcf)
    if given is not policy:
        contract.write(given)
    write_text(file, text)
    return written, guessed


def _experiment(file: Path, contract: PolicyContract, made: RobotPolicy, policy: Path, mjcf: Path) -> str:
    import tomlkit  # imported here, as in toml_text

    named, robot = (Path(os.path.relpath(path, file.parent)).as_posix() for path in (policy, mjcf))
    compiled = compile_mjcf(mjcf)[1]
    dt = contract.dt / contract.decimation
    start: list[Any] = _start(compiled, contract, made).tolist()
    space, command = _commands(made), dict[str, Any]()
    if space:
        command["command"] = list(space)
    else:  # tasks that start elsewhere
        positions = made.layout(len(start)).positions[:2] if contract.joints else [len(start) // 2 - 1]
        for k, position in enumerate(positions):
            space[f"start{k}"] = (start[position] - 0.1, start[position] + 0.1, "rad")
            start[position] = f"start{k}"
    task = {"initial_state": start, **command, "horizon": round(SECONDS / dt), "dt": dt}
    servos = made.contract.action.target == "position"
    before = {"before": np.asarray(contract.default)[made.layout(len(start)).inputs].tolist()} if servos else {}
    moving, distance = contract.base == "free", dict[str, Any]()
    if moving:
        distance = {"type": "BodyVelocity", "over": "average", "yaw": 0.5, "after": 0.5}
    elif contract.base == "planar":
        distance = {"type": "FinalState", "components": [0]}
    else:
        distance = {"type": "MaximumDeviation", "components": list(range(len(contract.joints) or 1))}
    invariant = list(proposed_invariant(compiled))
    simulator = tomlkit.inline_table()
    simulator.update({"type": "MuJoCo", "mjcf": robot, "dt": dt})
    parts = {
        "space": {name: list(given) for name, given in space.items()},
        "task": task,
        "system": {"type": "Imperfect", "step": simulator, "delay": 1.0, **before},
        "model": {"type": "MuJoCo", "mjcf": robot, "dt": dt, **({"invariant": invariant} if invariant else {})},
        "synthesizer": {"type": "RobotPolicy", "contract": named, "mjcf": robot},
        "distance": distance,
        **_names(compiled),
    }
    texts = {name: toml_text(table).strip() for name, table in parts.items()}
    units = "m/s" if moving else "m" if contract.base == "planar" else "rad"
    template = (Path(__file__).parent / "example" / "policy.toml").read_text("utf-8")
    return Template(template).substitute(texts, name=shell_word(file.name), title=file.stem, units=units)


def _names(compiled: Any) -> dict[str, dict[str, str]]:
    """Return the names of states ``(qpos, qvel)`` and of inputs with their units; none of them is there twice."""
    kinds = {  # names and units of the positions and of the velocities of a joint
        0: (("x", "y", "z", "qw", "qx", "qy", "qz"), ("m",) * 3 + ("",) * 4, ("vx", "vy", "vz", "wx", "wy", "wz")),
        1: (("qw", "qx", "qy", "qz"), ("",) * 4, ("wx", "wy", "wz")),
        2: (("",), ("m",), ("rate",)),
        3: (("",), ("rad",), ("rate",)),
    }
    positions, velocities = dict[str, str](), dict[str, str]()
    for k in range(compiled.njnt):
        kind, joint = int(compiled.jnt_type[k]), compiled.joint(k).name or f"joint{k}"
        of_position, units, of_velocity = kinds[kind]
        prefix = "" if k == 0 and kind == 0 else f"{joint}_"
        positions |= {f"{prefix}{name}".removesuffix("_"): unit for name, unit in zip(of_position, units, strict=True)}
        moved = "m/s" if kind == 2 else "rad/s"
        velocities |= {f"{prefix}{name}": "m/s" if name in ("vx", "vy", "vz") else moved for name in of_velocity}
    inputs = {compiled.actuator(k).name or f"u{k}": "" for k in range(compiled.nu)}
    return {"states": positions | velocities, "inputs": inputs}


def _commands(made: RobotPolicy) -> dict[str, tuple[float, float, str]]:
    """Return the ranges of the components of the command; none if the policy observes none."""
    if not made.observes("command"):
        return {}
    known = sum(size for _, size in made.widths(0))
    each = sum(size for _, size in made.widths(1)) - known
    count = 3 if made.network.widths[0] is None else (made.network.widths[0] - known) // each
    if count == 3:
        return dict(COMMANDS)
    return {f"command{k}": (-1.0, 1.0, "") for k in range(count)}


def _start(compiled: Any, contract: PolicyContract, made: RobotPolicy) -> Array:
    """Return the state of the first keyframe, or the default pose, at rest."""
    start = np.zeros(compiled.nq + compiled.nv)
    start[: compiled.nq] = compiled.key_qpos[0] if compiled.nkey else compiled.qpos0
    if not compiled.nkey and contract.joints:
        start[made.layout(len(start)).positions] = contract.default
    return start


# Contracts of networks without one


def drafted(policy: Path, mjcf: Path) -> tuple[PolicyContract, str]:
    """Return a contract that fits the sizes of a network and an MJCF, and a sentence about it.

    A network that takes as many numbers as there are states, or one or two less, takes the states. Otherwise the usual
    orders of observations are tried on the MJCF, and the one whose robot follows a command best is taken.
    """
    network, compiled = read_network(policy), compile_mjcf(mjcf)[1]
    wanted, states = network.widths[0], int(compiled.nq + compiled.nv)
    kinds = compiled.jnt_type.tolist()
    base = "free" if kinds[:1] == [0] else "planar" if kinds[:3] == [2, 2, 3] else "fixed"
    if wanted is not None and states - 2 <= wanted <= states and network.width == compiled.nu:
        term = Term("states", values=list(range(states - wanted, states)))
        dt = (5 if compiled.opt.timestep > 0.005 else 4) * float(compiled.opt.timestep)  # as gymnasium has them
        contract = PolicyContract(policy, [term], dt, action=Action(target="direct", clip=1.0), base=base)  # type: ignore[arg-type]
        return contract, f"its observation are states {states - wanted} to {states - 1}, and it acts every {dt:g} s"
    if base != "free" or not all(bias == 1 for bias in compiled.actuator_biastype):
        advice = "give its contract, or a --descriptor of Isaac Lab, mujoco_playground or unitree_rl_gym"
        raise InputError(
            f"what {policy} observes cannot be guessed, because its robot has no position servos: {advice}."
        )
    if not compiled.nkey:
        raise InputError(f"{mjcf} has no keyframe, which would be the default pose: give the contract of the policy.")
    candidates = list[tuple[float, PolicyContract]]()
    for contract in _candidates(policy, network, compiled):
        try:
            candidates.append((_error(contract, mjcf, compiled), contract))
        except CtxvalError:  # a size that does not fit
            continue
    if not candidates:
        raise InputError(f"{policy} takes {wanted} numbers, which no usual observation has: give its contract.")
    error, best = min(candidates, key=lambda pair: pair[0])
    follows = f"its robot follows a command of 0.5 m/s with an error of {error:.2g} m/s in the MJCF"
    return best, follows if np.isfinite(error) else "its robot falls in the MJCF with each of the usual observations"


def _candidates(policy: Path, network: PolicyNetwork, compiled: Any) -> list[PolicyContract]:
    names = [compiled.joint(int(joint)).name for joint in sorted(compiled.actuator_trnid[:, 0])]
    pose = compiled.key_qpos[0]
    default = [float(pose[int(compiled.joint(name).qposadr[0])]) for name in names]
    height = float(pose[2])
    velocity, command = Term("linear_velocity", at=imu_of(compiled)), Term("command")
    body, joints = [Term("angular_velocity"), Term("gravity")], [Term("joint_errors"), Term("joint_rates")]
    orders = [[*body, *joints, Term("last_action"), command], [*body, command, *joints, Term("last_action")]]
    wanted, found = network.widths[0], list[PolicyContract]()
    for order, with_velocity, scale in product(orders, (True, False), (0.5, 0.25)):
        terms = [velocity, *order] if with_velocity else order
        if wanted == 6 + 3 * with_velocity + 3 * len(names) + 3:
            found.append(
                PolicyContract(
                    policy,
                    terms,
                    PERIOD,
                    names,
                    default,
                    Action(scale=scale),
                    fall_height=round(0.5 * height, 3),
                    fall_tilt=1.0,
                )
            )
    return found


def _error(contract: PolicyContract, mjcf: Path, compiled: Any) -> float:
    """Return how far a robot misses a command in the MJCF, m/s; infinite if it falls."""
    made, dt = RobotPolicy(contract, mjcf=mjcf), contract.dt
    task = Task(_start(compiled, contract, made), horizon=round(SECONDS / dt), dt=dt, command=[0.5, 0.0, 0.0])
    system = MuJoCo(mjcf, substeps=round(dt / compiled.opt.timestep))
    run = system.execute(made.design(task, Model(mjcf, dt=dt)), task)
    if not run.finite.all() or (made.fall is not None and made.fall.seconds(run) is not None):
        return float("inf")
    return float(CommandError(after=1.0, yaw=0.5)(run, run, task))
