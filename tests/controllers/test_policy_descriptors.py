"""Contracts from the descriptors of Isaac Lab, unitree_rl_gym and mujoco_playground, in their formats."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ctxval.controllers import PolicyContract, Term, convert_policy
from ctxval.errors import InputError
from facts import refuses

yaml = pytest.importorskip("yaml")
pytest.importorskip("mujoco")

# Two legs with hip and knee, and a velocimeter at an IMU.
LEG = """<body pos="{y} 0 0"><joint name="{side}_hip_joint" axis="0 1 0"/><geom size="0.05"/>
<body pos="0 0 -0.2"><joint name="{side}_knee_joint" axis="0 1 0"/><geom size="0.05"/></body></body>"""
MJCF = f"""<mujoco><worldbody><body name="trunk" pos="0 0 0.5"><freejoint/><geom size="0.1"/>
<site name="imu" pos="0.1 0 0.02"/>{LEG.format(side="left", y=0.1)}{LEG.format(side="right", y=-0.1)}</body></worldbody>
<sensor><velocimeter site="imu"/></sensor>
<keyframe><key name="home" qpos="0 0 0.5 1 0 0 0 0.1 -0.2 0.3 -0.4"/></keyframe></mujoco>"""

ISAAC = """
sim: {dt: 0.005, gravity: !!python/tuple [0.0, 0.0, -9.81]}
decimation: 4
scene:
  robot:
    init_state:
      joint_pos: {.*_hip_joint: 0.1, left_knee_joint: -0.5, right_knee_joint: -0.6}
    actuators:
      hips: {joint_names_expr: [.*_hip_.*], stiffness: {.*_hip_.*: 100.0}, damping: {.*_hip_.*: 2.0}}
      knees: {joint_names_expr: [.*_knee_.*], stiffness: 150.0, damping: 4.0}
observations:
  policy:
    concatenate_terms: true
    history_length: 5
    base_ang_vel: {func: 'isaaclab.envs.mdp.observations:base_ang_vel', clip: null, scale: 0.2, history_length: 0}
    projected_gravity: {func: 'isaaclab.envs.mdp.observations:projected_gravity', clip: null, scale: null}
    commands: {func: 'isaaclab.envs.mdp.observations:generated_commands', params: {command_name: base}, scale: null}
    joint_pos: {func: 'isaaclab.envs.mdp.observations:joint_pos_rel', clip: !!python/tuple [-1.0, 1.0], scale: null}
    joint_vel: {func: 'isaaclab.envs.mdp.observations:joint_vel_rel', scale: 0.05}
    actions: {func: 'isaaclab.envs.mdp.observations:last_action', scale: null}
  critic: {}
actions:
  joints: {class_type: 'isaaclab.envs.mdp.actions.joint_actions:JointPositionAction', scale: 0.25, clip: null}
events:
  mass: {params: {ids: !!python/object/apply:builtins.slice [null, null, null]}}
terminations:
  time_out: {func: 'isaaclab.envs.mdp.terminations:time_out', params: {}}
  height: {func: 'isaaclab.envs.mdp.terminations:root_height_below_minimum', params: {minimum_height: 0.2}}
  tilt: {func: 'isaaclab.envs.mdp.terminations:bad_orientation', params: {limit_angle: 0.8}}
"""


def test_env_yaml_of_isaac_lab(tmp_path: Path) -> None:
    (tmp_path / "env.yaml").write_text(ISAAC)
    contract = convert_policy(tmp_path / "env.yaml", tmp_path / "p.onnx", mjcf=MJCF)
    assert contract.joints == ("left_hip_joint", "right_hip_joint", "left_knee_joint", "right_knee_joint")
    assert contract.default == (0.1, 0.1, -0.5, -0.6)
    assert contract.action.kp == (100.0, 100.0, 150.0, 150.0)
    assert contract.action.kd == (2.0, 2.0, 4.0, 4.0)
    assert (contract.dt, contract.decimation, contract.fall_height, contract.fall_tilt) == (0.02, 4, 0.2, 0.8)
    names = ["angular_velocity", "gravity", "command", "joint_errors", "joint_rates", "last_action"]
    assert [term.term for term in contract.observation] == names
    assert {term.history for term in contract.observation} == {5}
    assert contract.observation[0].scale == 0.2
    assert contract.observation[3].clip == (-1.0, 1.0)
    assert PolicyContract.read(contract.write(tmp_path / "a.toml")) == contract
    (tmp_path / "other.yaml").write_text(ISAAC.replace("joint_vel_rel", "height_scan"))
    with refuses(InputError, "height_scan"):
        convert_policy(tmp_path / "other.yaml", "p.onnx", mjcf=MJCF)
    with refuses(InputError, "order"):
        convert_policy(tmp_path / "env.yaml", "p.onnx")


@pytest.mark.parametrize("whole", [True, False])
def test_deploy_yaml_of_isaac_lab(tmp_path: Path, whole: bool) -> None:
    # The interface has six motors, of which 2 and 5 are absent; the policy has hips first.
    gains = [1.0, 2.0, 0.0, 4.0, 5.0, 0.0] if whole else [1.0, 2.0, 4.0, 5.0]
    table = {
        "joint_ids_map": [0, 3, 1, 4],
        "step_dt": 0.02,
        "stiffness": gains,
        "damping": [0.1 * gain for gain in gains],
        "default_joint_pos": [0.1, 0.2, 0.3, 0.4],
        "actions": {"JointPositionAction": {"clip": None, "scale": [0.25] * 4, "offset": [0.1, 0.2, 0.3, 0.4]}},
        "observations": {
            "base_ang_vel": {"scale": [0.2] * 3, "clip": None, "history_length": 1, "params": {}},
            "gait_phase": {"params": {"period": 0.8}, "scale": None, "history_length": 1},
            "velocity_commands": {"scale": [2.0, 2.0, 0.25], "history_length": 1, "params": {}},
        },
    }
    (tmp_path / "deploy.yaml").write_text(yaml.safe_dump(table))
    contract = convert_policy(tmp_path / "deploy.yaml", "p.onnx")
    assert contract.joints == (0, 2, 1, 3)
    assert contract.action.kp == (1.0, 4.0, 2.0, 5.0)
    assert contract.observation[1] == Term("clock", period=0.8)
    assert contract.observation[2].scale == (2.0, 2.0, 0.25)


@pytest.mark.parametrize(("more", "clock"), [(0, False), (2, True)])
def test_configurations_of_unitree(tmp_path: Path, more: int, clock: bool) -> None:
    table = {
        "policy_path": "{LEGGED_GYM_ROOT_DIR}/motion.pt",
        "simulation_dt": 0.002,
        "control_decimation": 10,
        "kps": [100.0] * 4,
        "kds": [2.0] * 4,
        "default_angles": [0.1, -0.2, 0.3, -0.4],
        "ang_vel_scale": 0.25,
        "dof_pos_scale": 1.0,
        "dof_vel_scale": 0.05,
        "action_scale": 0.25,
        "cmd_scale": [2.0, 2.0, 0.25],
        "num_actions": 4,
        "num_obs": 21 + more,
    }
    (tmp_path / "g1.yaml").write_text(yaml.safe_dump(table))
    contract = convert_policy(tmp_path / "g1.yaml", "motion.pt")
    assert (contract.dt, contract.decimation) == (0.02, 10)
    assert contract.joints == (0, 1, 2, 3)
    assert contract.action.scale == 0.25
    assert [term.term for term in contract.observation][-1] == ("clock" if clock else "last_action")
    real = {name: value for name, value in table.items() if name not in ("simulation_dt", "control_decimation")}
    (tmp_path / "real.yaml").write_text(yaml.safe_dump({**real, "control_dt": 0.02}))
    assert convert_policy(tmp_path / "real.yaml", "motion.pt") == contract
    (tmp_path / "other.yaml").write_text(yaml.safe_dump({**table, "num_obs": 30}))
    with refuses(InputError, "30"):
        convert_policy(tmp_path / "other.yaml", "motion.pt")


def test_config_json_of_playground(tmp_path: Path) -> None:
    table = {"ctrl_dt": 0.02, "sim_dt": 0.004, "action_scale": 0.5, "history_len": 1, "Kp": 35.0}
    (tmp_path / "config.json").write_text(json.dumps(table))
    contract = convert_policy(tmp_path / "config.json", "p.onnx", mjcf=MJCF)
    assert contract.default == pytest.approx((0.1, -0.2, 0.3, -0.4))
    assert contract.observation[0] == Term("linear_velocity", at=(0.1, 0.0, 0.02))
    assert contract.observation[-1].term == "command"
    assert contract.fall_tilt == pytest.approx(np.pi / 2)


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: !!python/object/apply:os.system ['touch here']\nb: 1")
    with refuses(InputError, "a, b"):
        convert_policy(tmp_path / "a.yaml", "p.onnx")
    assert not Path("here").exists()
    (tmp_path / "b.yaml").write_text("[1, 2]")
    with refuses(InputError, "table"):
        convert_policy(tmp_path / "b.yaml", "p.onnx")
