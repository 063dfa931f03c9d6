"""``ctxval init --policy``: an experiment file for a trained policy and the MJCF of its robot."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ctxval import Validation, systems
from ctxval.cli import app, policies
from ctxval.cli.config.settings import read_settings
from ctxval.controllers import Action, PolicyContract, Term
from ctxval.errors import InputError
from facts import refuses
from go1_robot import go1_contract, go1_mjcf

pytest.importorskip("mujoco")

MJCF = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="5 5 .1"/>
<body pos="0 0 0.3"><freejoint/><geom type="box" size="0.2 0.2 0.05" mass="4"/>{legs}</body></worldbody>
<actuator>{actuators}</actuator><keyframe><key qpos="0 0 0.35 1 0 0 0 0 0"/></keyframe></mujoco>"""
LEG = """<body pos="{x} 0 0"><joint name="{name}" axis="0 1 0" damping="1"/>
<geom type="capsule" fromto="0 .2 0 0 .2 -.3" size=".03"/><geom type="capsule" fromto="0 -.2 0 0 -.2 -.3" size=".03"/>
</body>"""
LEGS = LEG.format(x=0.2, name="front") + LEG.format(x=-0.2, name="back")
SERVOS = '<position name="f" joint="front" kp="60" kv="2"/><position name="b" joint="back" kp="60" kv="2"/>'


def robot(folder: Path, actuators: str = SERVOS) -> Path:
    (folder / "robot.xml").write_text(MJCF.format(legs=LEGS, actuators=actuators))
    return folder / "robot.xml"


def network(path: Path, inputs: int, outputs: int = 2) -> Path:
    np.savez(path, W0=0.01 * np.random.default_rng(0).normal(size=(outputs, inputs)))
    return path


def executed(file: Path) -> Validation:
    validation = read_settings(str(file), {}).load().validation
    space = validation.space
    assert np.isfinite(validation.outcome(0.5 * (space.low + space.high)).distance)
    return validation


def test_a_contract_gets_an_experiment(tmp_path: Path) -> None:
    contract = PolicyContract(
        network=network(tmp_path / "p.npz", 2 + 3 + 2),
        observation=[Term("joint_errors"), Term("gravity"), Term("command")],
        dt=0.02,
        joints=["back", "front"],
        default=[0.0, 0.1],
        action=Action(scale=0.2),
        fall_height=0.1,
    )
    (tmp_path / "sub").mkdir()
    given = contract.write(tmp_path / "sub" / "robot.toml")
    file, mjcf = str(tmp_path / "a.toml"), str(robot(tmp_path))
    assert CliRunner().invoke(app, ["init", file, "--policy", str(given)]).exit_code != 0
    assert CliRunner().invoke(app, ["init", file, "--mjcf", mjcf]).exit_code != 0
    run = CliRunner().invoke(app, ["init", file, "--policy", str(given), "--mjcf", mjcf])
    assert run.exit_code == 0, run.output
    assert CliRunner().invoke(app, ["init", file, "--policy", str(given), "--mjcf", mjcf]).exit_code != 0
    table = tomllib.loads((tmp_path / "a.toml").read_text())
    assert table["task"]["command"] == ["command0", "command1"]
    assert table["system"]["before"] == [0.1, 0.0]
    assert list(table["states"])[5:9] == ["qy", "qz", "front", "back"]
    assert table["states"]["back_rate"] == "rad/s"
    assert list(table["inputs"]) == ["f", "b"]
    validation = executed(tmp_path / "a.toml")
    assert validation.fall is not None
    assert isinstance(validation.system, systems.Imperfect)


def test_a_network_of_states_needs_no_contract(tmp_path: Path) -> None:
    # A gymnasium environment of a planar robot shows its states without the place.
    planar = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="9 9 1"/><body pos="0 0 .3">
    <joint name="rootx" type="slide" axis="1 0 0"/><joint name="rootz" type="slide" axis="0 0 1"/>
    <joint name="rooty" axis="0 1 0"/><geom size=".1" mass="2"/><body><joint name="leg" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03"/></body></body></worldbody><actuator><motor joint="leg"/>
    </actuator></mujoco>"""
    (tmp_path / "robot.xml").write_text(planar)
    contract, guessed = policies.drafted(network(tmp_path / "p.npz", 7, 1), tmp_path / "robot.xml")
    assert contract.observation == (Term("states", values=[*range(1, 8)]),)
    assert (contract.base, contract.dt) == ("planar", 0.05)
    assert "1 to 7" in guessed
    policies.write_experiment(tmp_path / "a.toml", tmp_path / "p.npz", tmp_path / "robot.xml", None)
    assert executed(tmp_path / "a.toml").space.names == ("start0",)


def test_a_descriptor_gives_the_contract(tmp_path: Path) -> None:
    table = {"ctrl_dt": 0.02, "sim_dt": 0.004, "action_scale": 0.3, "history_len": 1}
    (tmp_path / "config.json").write_text(json.dumps(table))
    given = network(tmp_path / "p.npz", 9 + 6 + 3)
    written, _ = policies.write_experiment(tmp_path / "a.toml", given, robot(tmp_path), tmp_path / "config.json")
    assert written[1] == tmp_path / "a_policy.toml"
    assert PolicyContract.read(written[1]).action.scale == 0.3
    assert executed(tmp_path / "a.toml").space.names == ("vx", "vy", "yaw_rate")
    with refuses(InputError, "a_policy.toml"):
        policies.write_experiment(tmp_path / "a.toml", given, robot(tmp_path), None)


def test_what_cannot_be_guessed_is_refused(tmp_path: Path) -> None:
    with refuses(InputError, "servos"):
        motors = robot(tmp_path, '<motor joint="front"/><motor joint="back"/>')
        policies.drafted(network(tmp_path / "p.npz", 18), motors)
    with refuses(InputError, "33"):
        policies.drafted(network(tmp_path / "p.npz", 33), robot(tmp_path))


def test_the_policy_of_go1_is_guessed_from_its_network(tmp_path: Path) -> None:
    (tmp_path / "go1.xml").write_text(go1_mjcf())
    known = go1_contract()
    shutil.copy(known.network, tmp_path / "policy.onnx")
    contract, guessed = policies.drafted(tmp_path / "policy.onnx", tmp_path / "go1.xml")
    assert contract.observation == known.observation
    assert contract.action == known.action
    assert contract.joints == known.joints
    assert "0.5 m/s" in guessed
