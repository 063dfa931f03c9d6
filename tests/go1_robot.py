"""The Unitree Go1 of the package ``playground`` without its meshes, and the contract of its policy."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from ctxval.controllers import Action, PolicyContract, Term
from shared_data import shared_data

HOME = (0.1, 0.9, -1.8, -0.1, 0.9, -1.8) * 2
JOINTS = tuple(f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf"))
START = (0.0, 0.0, 0.278, 1.0, 0.0, 0.0, 0.0, *HOME, *[0.0] * 18)


def go1_mjcf(friction: float = 0.6, payload: float = 0.0) -> str:
    """Return the MJCF on a floor; skip the test if the package is missing."""
    mujoco = pytest.importorskip("mujoco")
    found = importlib.util.find_spec("mujoco_playground")
    if found is None or found.origin is None:
        pytest.skip("needs the MJCF of Go1: pip install playground --no-deps")
    spec = mujoco.MjSpec.from_file(str(Path(found.origin).parent / "_src/locomotion/go1/xmls/go1_mjx_feetonly.xml"))
    for geom in [each for each in spec.geoms if each.type == mujoco.mjtGeom.mjGEOM_MESH]:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    floor = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 0.01], "friction": [friction, 0.005, 0.0001]}
    spec.worldbody.add_geom(name="floor", contype=1, conaffinity=0, priority=1, condim=3, **floor)
    spec.body("trunk").mass += payload
    spec.add_key(name="home", qpos=list(START[:19]))
    spec.compile()
    text: str = spec.to_xml()
    return text


def go1_contract() -> PolicyContract:
    """Return the contract of the joystick policy of mujoco_playground; skip the test if its file is missing."""
    terms = ["angular_velocity", "gravity", "joint_errors", "joint_rates", "last_action", "command"]
    return PolicyContract(
        network=shared_data("policies/go1_joystick.onnx"),
        observation=(Term("linear_velocity", at=(-0.01592, -0.06659, -0.00617)), *map(Term, terms)),  # type: ignore[arg-type]
        dt=0.02,
        joints=JOINTS,
        default=HOME,
        action=Action(scale=0.5),
        fall_height=0.15,
        fall_tilt=1.0,
    )
