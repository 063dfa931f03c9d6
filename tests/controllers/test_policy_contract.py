"""The contract of a policy as a file, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval.controllers import Action, PolicyContract, Term
from ctxval.errors import InputError, ShapeError, UnknownNameError
from facts import refuses

TEXT = """
network = "policy.onnx"
dt = 0.02
decimation = 4
latency = 0.005
joints = ["hip", "knee"]
default = [0.1, -0.2]
history = 3
fall_height = 0.18
fall_tilt = 1.0
observation = [
  "angular_velocity",
  { term = "gravity", scale = 2.0, clip = [-1.0, 0.5] },
  { term = "clock", period = 0.8, phases = [0.0, 0.5] },
  "joint_errors", "last_action", "command",
]

[action]
target = "torque"
scale = [0.25, 0.5]
kp = 30.0
kd = [0.5, 0.6]
"""


def test_a_contract_is_read_and_written(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(TEXT)
    contract = PolicyContract.read(tmp_path / "a.toml")
    assert contract.network == tmp_path / "policy.onnx"
    assert [term.term for term in contract.observation][:3] == ["angular_velocity", "gravity", "clock"]
    assert contract.observation[1].clip == (-1.0, 0.5)
    assert contract.action.kd == (0.5, 0.6)
    assert (contract.decimation, contract.latency, contract.fall_tilt) == (4, 0.005, 1.0)
    written = contract.write(tmp_path / "b.toml")
    assert PolicyContract.read(written) == contract
    assert "newest" not in written.read_text()


def test_a_term_is_clipped_then_moved_and_scaled() -> None:
    term = Term("command", scale=[2.0, 3.0], offset=0.5, clip=1.0)
    assert term.of(np.array([[4.0, -4.0]])).tolist() == [[1.0, -4.5]]
    assert Term("command", scale=np.array([2.0, 3.0])) == Term("command", scale=[2.0, 3.0])


@pytest.mark.parametrize(
    ("changed", "fact"),
    [
        ({"observation": []}, "terms"),
        ({"default": [0.0]}, "1 numbers"),
        ({"joints": [], "default": []}, "joints"),
        ({"action": {"target": "torque"}}, "kp"),
        ({"base": "fixed", "fall_height": 0.1}, "fixed"),
        ({"base": "planar", "observation": ["gravity"]}, "gravity"),
        ({"observation": [{"term": "constant"}]}, "constant"),
        ({"observation": [{"term": "linear_velocity", "at": [0.0]}]}, "three"),
        ({"observation": [{"term": "height_scan"}]}, "height_scan"),
        ({"observation": "gravity"}, "list"),
        ({"dt": -1.0}, "dt"),
        ({"speed": 1.0}, "speed"),
        ({"dt": None}, "dt"),
    ],
)
def test_what_is_no_contract_is_refused(changed: dict[str, Any], fact: str) -> None:
    table: dict[str, Any] = {
        "network": "a.onnx",
        "dt": 0.02,
        "joints": ["hip", "knee"],
        "default": [0.0, 0.0],
        "observation": ["joint_errors"],
    }
    table = {name: value for name, value in {**table, **changed}.items() if value is not None}
    with refuses((InputError, ShapeError, UnknownNameError), fact):
        PolicyContract.from_table(table)


def test_actions_have_their_defaults() -> None:
    assert Action() == Action(target="position", scale=1.0)
