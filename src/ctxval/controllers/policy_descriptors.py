"""Contracts of policies from the descriptors of other projects: Isaac Lab, mujoco_playground and unitree_rl_gym.

Their files state scales, gains and times. What they leave to code is stated here, with its source. A contract that was
converted is a file to read and to correct.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ctxval._util.files import read_bytes
from ctxval._util.mjcf import compile_mjcf
from ctxval._util.refusals import require_extra, reworded
from ctxval.controllers.policy_contract import Action, PolicyContract, Term, TermName
from ctxval.errors import InputError


def convert_policy(
    descriptor: str | Path, network: str | Path, *, mjcf: str | Path | None = None, joints: Sequence[str] | None = None
) -> PolicyContract:
    """Return the contract of a policy from a file of another project.

    Args:
        descriptor: ``env.yaml`` of Isaac Lab, or ``deploy.yaml`` that its exporters write; ``config.json`` that
            mujoco_playground writes beside its checkpoints; a YAML file in ``deploy/*/configs`` of unitree_rl_gym.
        network: the exported network.
        mjcf: the MJCF of the robot, which the first and the third need for the order of joints or the default pose.
        joints: names of the joints in the order of the policy, if the descriptor has no order. By default, those of
            ``env.yaml`` are in the order of Isaac Lab, one depth of the kinematic tree after the other.

    Raises:
        InputError: if the file is none of the known ones.
    """
    with reworded(f"{descriptor} cannot be read as a descriptor of a policy"):
        table = _read(Path(descriptor))
        kinds: tuple[tuple[set[str], Callable[..., PolicyContract]], ...] = (
            ({"step_dt", "joint_ids_map", "observations"}, _of_deployment),
            ({"sim", "decimation", "observations", "scene"}, _of_isaac_lab),
            ({"kps", "kds", "default_angles", "num_obs"}, _of_unitree),
            ({"ctrl_dt", "sim_dt", "action_scale"}, _of_playground),
        )
        for names, convert in kinds:
            if names <= set(table):
                return convert(table, network, mjcf, joints)
        known = "Isaac Lab, mujoco_playground and unitree_rl_gym"
        raise InputError(f"it is none of {known}; it has {', '.join(map(str, table))[:200]}.")


def _read(path: Path) -> dict[str, Any]:
    content = read_bytes(path, 2**24)
    if path.suffix == ".json":
        table = json.loads(content)
    else:
        yaml = require_extra("yaml", "onnx", "descriptors of policies in YAML need")

        class Plain(yaml.SafeLoader):  # type: ignore[name-defined, misc]
            """Reads tuples and slices of Python as lists, and makes no other object of a tag."""

        def plain(loader: Any, _: str, node: Any) -> Any:
            if isinstance(node, yaml.SequenceNode):
                return loader.construct_sequence(node, deep=True)
            return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else str(node.value)

        Plain.add_multi_constructor("tag:yaml.org,2002:python/", plain)
        table = yaml.load(content, Loader=Plain)
    if not isinstance(table, dict):
        raise InputError("it must be a table of names and values.")
    return table


# Isaac Lab

_TERMS: dict[str, TermName] = {  # functions of isaaclab.envs.mdp.observations, and names in deploy.yaml
    "base_lin_vel": "linear_velocity",
    "base_ang_vel": "angular_velocity",
    "projected_gravity": "gravity",
    "base_pos_z": "height",
    "root_quat_w": "quaternion",
    "joint_pos": "joint_positions",
    "joint_pos_rel": "joint_errors",
    "joint_vel": "joint_rates",
    "joint_vel_rel": "joint_rates",
    "last_action": "last_action",
    "generated_commands": "command",
    "velocity_commands": "command",
    "gait_phase": "clock",
}


def _of_isaac_lab(
    table: Mapping[str, Any], network: str | Path, mjcf: str | Path | None, joints: Sequence[str] | None
) -> PolicyContract:
    robot, group = table["scene"]["robot"], table["observations"]["policy"]
    names = list(joints) if joints is not None else _by_depth(mjcf)
    history = group.get("history_length") or 0
    terms = [
        _term(str(each["func"]).rpartition(":")[2], {**each, "history_length": history or each.get("history_length")})
        for each in group.values()
        if isinstance(each, Mapping) and "func" in each
    ]
    gains = {"stiffness": np.zeros(len(names)), "damping": np.zeros(len(names))}
    for actuator in robot["actuators"].values():
        for gain, values in gains.items():
            for k in _matching(names, actuator["joint_names_expr"]):
                values[k] = _by_pattern(actuator[gain], names[k])
    default = [_by_pattern(robot["init_state"]["joint_pos"], name) for name in names]
    [(kind, action)] = table["actions"].items()
    if "JointPositionAction" not in str(action["class_type"]):
        raise InputError(f"the action {kind} is none of positions of joints; it is {action['class_type']}.")
    ends = {str(each.get("func")).rpartition(":")[2]: each.get("params", {}) for each in table["terminations"].values()}
    return PolicyContract(
        network=network,
        observation=terms,
        dt=table["decimation"] * table["sim"]["dt"],
        decimation=table["decimation"],
        joints=names,
        default=default,
        action=Action(
            target="torque",
            scale=_scale(action["scale"], names),
            kp=gains["stiffness"].tolist(),
            kd=gains["damping"].tolist(),
        ),
        fall_height=ends.get("root_height_below_minimum", {}).get("minimum_height"),
        fall_tilt=ends.get("bad_orientation", {}).get("limit_angle"),
    )


def _of_deployment(
    table: Mapping[str, Any], network: str | Path, mjcf: str | Path | None, joints: Sequence[str] | None
) -> PolicyContract:
    # The numbers are those of the robot's interface. Some may be absent, and the MJCF has the others in their order.
    order = np.argsort(np.argsort(table["joint_ids_map"]))
    whole = len(table["stiffness"]) > len(order)
    rows = table["joint_ids_map"] if whole else order
    kp, kd = (np.asarray(table[name], dtype=np.float64)[rows].tolist() for name in ("stiffness", "damping"))
    [(kind, action)] = table["actions"].items()
    if kind != "JointPositionAction" or action.get("clip") is not None:
        raise InputError(f"the action must be JointPositionAction without a clip, got {kind}.")
    return PolicyContract(
        network=network,
        observation=[_term(name, each) for name, each in table["observations"].items()],
        dt=table["step_dt"],
        decimation=4,  # the interface closes this loop; Isaac Lab does so at 200 Hz, if actions come at 50 Hz
        joints=order.tolist() if joints is None else joints,
        default=table["default_joint_pos"],
        action=Action(target="torque", scale=action["scale"], kp=kp, kd=kd),
    )


def _term(name: str, table: Mapping[str, Any]) -> Term:
    if name not in _TERMS:
        raise InputError(f"the observation {name!r} is no term of a contract: {', '.join(get_args(TermName))}.")
    given = {key: table[key] for key in ("scale", "clip") if table.get(key) is not None}
    more = {"period": table.get("params", {}).get("period", 1.0)} if name == "gait_phase" else {}
    return Term(_TERMS[name], history=max(1, table.get("history_length") or 1), **given, **more)


def _by_depth(mjcf: str | Path | None) -> list[str]:
    """Return the joints of an MJCF as articulations of Isaac Lab have them: one depth of the tree after the other."""
    if mjcf is None:
        raise InputError(
            "env.yaml has no order of the joints: give the MJCF, or the joints in the order of the policy."
        )
    compiled = compile_mjcf(mjcf)[1]
    depths = dict[int, int]()
    for body in range(compiled.nbody):
        depths[body] = 0 if body == 0 else depths[int(compiled.body_parentid[body])] + 1
    scalar = [k for k in range(compiled.njnt) if compiled.jnt_type[k] >= 2]  # slides and hinges
    return [compiled.joint(k).name for k in sorted(scalar, key=lambda k: (depths[int(compiled.jnt_bodyid[k])], k))]


def _matching(names: Sequence[str], patterns: str | Sequence[str]) -> list[int]:
    given = [patterns] if isinstance(patterns, str) else patterns
    return [k for k, name in enumerate(names) if any(re.fullmatch(pattern, name) for pattern in given)]


def _by_pattern(values: float | Mapping[str, float] | None, name: str) -> float:
    """Return the value of a joint from a number for all, or from numbers by patterns of names; 0 if there is none."""
    if isinstance(values, Mapping):
        return float(next((value for pattern, value in values.items() if re.fullmatch(pattern, name)), 0.0))
    return float(values or 0.0)


def _scale(scale: float | Mapping[str, float], names: Sequence[str]) -> float | list[float]:
    return [_by_pattern(scale, name) for name in names] if isinstance(scale, Mapping) else float(scale)


# unitree_rl_gym: the order of the observation is that of deploy/deploy_mujoco/deploy_mujoco.py


def _of_unitree(
    table: Mapping[str, Any], network: str | Path, mjcf: str | Path | None, joints: Sequence[str] | None
) -> PolicyContract:
    count = len(table["default_angles"])
    clock = table["num_obs"] - (9 + 3 * count)
    if clock not in (0, 2):
        wanted = f"{9 + 3 * count} numbers, or two more of a clock"
        raise InputError(f"the observation of {count} joints must have {wanted}, got {table['num_obs']}.")
    dt = table.get("simulation_dt", 0.002)
    decimation = table.get("control_decimation") or round(table["control_dt"] / dt)
    terms = [
        Term("angular_velocity", scale=table["ang_vel_scale"]),
        Term("gravity"),
        Term("command", scale=table["cmd_scale"]),
        Term("joint_errors", scale=table["dof_pos_scale"]),
        Term("joint_rates", scale=table["dof_vel_scale"]),
        Term("last_action"),
        *[Term("clock", period=0.8)] * (clock // 2),
    ]
    return PolicyContract(
        network=network,
        observation=terms,
        dt=decimation * dt,
        decimation=decimation,
        joints=list(range(count)) if joints is None else joints,
        default=table["default_angles"],
        action=Action(target="torque", scale=table["action_scale"], kp=table["kps"], kd=table["kds"]),
    )


# mujoco_playground: the order of the observation is that of its quadrupeds, _src/locomotion/go1/joystick.py


def _of_playground(
    table: Mapping[str, Any], network: str | Path, mjcf: str | Path | None, joints: Sequence[str] | None
) -> PolicyContract:
    if mjcf is None:
        raise InputError("config.json has no default pose: give the MJCF, whose first keyframe is the pose.")
    compiled = compile_mjcf(mjcf)[1]
    pose = compiled.key_qpos[0] if compiled.nkey else compiled.qpos0
    names = [compiled.joint(k).name for k in range(1, compiled.njnt)] if joints is None else list(joints)
    rest = ("angular_velocity", "gravity", "joint_errors", "joint_rates", "last_action", "command")
    return PolicyContract(
        network=network,
        observation=[Term("linear_velocity", at=imu_of(compiled)), *map(Term, rest)],  # type: ignore[arg-type]
        dt=table["ctrl_dt"],
        joints=names,
        default=[pose[int(compiled.joint(name).qposadr[0])] for name in names],
        action=Action(scale=table["action_scale"]),
        history=max(1, table.get("history_len", 1)),
        history_order="newest first",
        history_start="zero",
        fall_tilt=np.pi / 2,
    )


def imu_of(compiled: Any) -> tuple[float, ...]:
    """Return the point of the base, ``(3,)``, at which a velocimeter of an MJCF measures; 0 if there is none."""
    velocimeters = [k for k in range(compiled.nsensor) if compiled.sensor_type[k] == 2]  # mjSENS_VELOCIMETER
    for k in velocimeters:
        site = int(compiled.sensor_objid[k])
        if compiled.site_bodyid[site] == compiled.jnt_bodyid[0]:
            return tuple(compiled.site_pos[site].tolist())
    return (0.0, 0.0, 0.0)
