"""``ctxval safe``, as users call it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from facts import assert_names
from rig_cli import Invoke, calling, report

FILE = """
name = "wall"
units = "m"
threshold = 7.0
budget = 20

[space]
wall = [0.4, 2.0, "m"]
speed = [0.5, 1.5, "m/s"]

[task]
initial_state = [0.0, 0.0]
goal = [1.0, 0.0]
environment = { wall = ["wall"], speed = ["speed"] }
horizon = 10
dt = 0.1

[spec]
components = ["position"]
avoid = { type = "Box", center = "wall", low = [0.0], high = [inf] }

[states]
position = "m"
clock = "s"

[system]
type = "Simulated"
step = { ref = "safe_drive:step" }
vectorized = true

[model]
type = "Linear"
A = [[1.0, 0.0], [0.0, 1.0]]
B = [[0.1], [0.0]]

[synthesizer]
type = "Policy"
policy = { ref = "safe_drive:policy" }

[distance]
type = "FinalState"
components = ["position"]
"""

MODULE = """
import numpy as np


def step(x, u):
    return x + np.concatenate([0.1 * (u + 0.3 * u**2), 0.0 * u], axis=-1)


def policy(t, x, task):
    return np.broadcast_to(task.environment["speed"], (*x.shape[:-1], 1))
"""

D_B = 2.0 - (3.4**0.5 - 1) / 0.6


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    (tmp_path / "safe_drive.py").write_text(MODULE)
    (tmp_path / "wall.toml").write_text(FILE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    yield tmp_path
    sys.modules.pop("safe_drive", None)


@pytest.fixture
def invoke(folder: Path) -> Invoke:
    return calling()


@pytest.mark.slow
def test_it_finds_the_margin_and_other_commands_read_its_store(folder: Path, invoke: Invoke) -> None:
    found = report(invoke("safe", "wall.toml", "--audit", "12", "--json"))
    assert found["units"] == "m"
    assert D_B - 1e-3 <= found["d_b_bound"] <= 1.1 * D_B
    assert found["d_b"] <= D_B + 1e-9 <= found["d_a"] + 0.2
    assert found["counterexamples"][0]["on_system"] <= 0 < found["counterexamples"][0]["on_model"]
    assert found["avoid"] == [f"Box(center='wall', low=[-{found['d_b_bound']:.4g}], high=[inf])"]
    assert (found["drawn"]["draws"], found["drawn"]["unsafe"]) == (12, 0)
    assert found["store"] == str(Path("runs") / "wall-auto-seed0.safe.sqlite")
    assert report(invoke("status", found["store"], "--json"))["executions"] == found["executions"]
    assert (
        report(invoke("certify", found["store"], "--kind", "dynamics", "--json"))["upper_bound"] <= found["d_b_bound"]
    )
    # Asked again for a margin, the same executions count, with their distances computed again.
    asked = invoke("safe", "wall.toml", "--margin", "0.3")
    assert asked.exit_code == 1
    assert "FALSIFIED: margin 0.3 m" in asked.stdout
    assert_names(asked.output, "executions")
    assert "unsafe: wall = " in asked.stdout


@pytest.mark.thorough
def test_check_says_what_the_model_does(folder: Path, invoke: Invoke) -> None:
    checked = invoke("check", "wall.toml")
    assert checked.exit_code == 0
    # At the ends of the space: a wall at 0.4 m and a speed of 0.5 m/s, and a wall at 2 m and a speed of 0.5 to 1.5 m/s.
    (folder / "wall.toml").write_text(FILE.replace('center = "wall"', "center = [-9.0]"))
    assert_names(invoke("check", "wall.toml").stdout, 0, 11)
    (folder / "wall.toml").write_text(FILE.replace('"wall", low', '"wal", low'))
    assert_names(" ".join(invoke("check", "wall.toml").output.split()), "wal")


@pytest.mark.parametrize(
    ("old", "new", "facts"),
    [
        ("[spec]", "[spek]", ("spek", "spec")),
        ('avoid = { type = "Box", center = "wall", low = [0.0], high = [inf] }', "", ()),
        ("low = [0.0], high = [inf]", "low = [0.0, 0.0], high = [inf, 1.0]", ("Box", 1)),
        (
            'center = "wall"',
            'center = "wal"',
            ("wall",),
        ),
        ('["position"]\navoid', '["place"]\navoid', ("place",)),
        ('center = "wall"', "center = [-9.0]", ()),
        ("avoid = { type", "margin = -1.0\navoid = { type", ("spec.margin",)),
        ('type = "Box"', 'type = "Bax"', ("Bax", "Box")),
    ],
)
def test_bad_input_is_one_sentence(folder: Path, invoke: Invoke, old: str, new: str, facts: tuple[object, ...]) -> None:
    (folder / "wall.toml").write_text(FILE.replace(old, new))
    refused = invoke("safe", "wall.toml")
    assert refused.exit_code == 2
    assert_names(" ".join(refused.stderr.split()), *facts)
    assert refused.stderr.count("error: ") == 1
    assert not (folder / "runs").exists()


def test_bad_options_are_refused_before_anything_is_executed(folder: Path, invoke: Invoke) -> None:
    for option, value, facts in (
        ("--margin", "-0.1", ("--margin",)),
        ("--audit", "0", ("--audit", 0)),
    ):
        refused = invoke("safe", "wall.toml", option, value)
        assert refused.exit_code == 2
        assert_names(refused.stderr, *facts)
    assert not (folder / "runs").exists()


def test_an_experiment_without_a_specification_is_refused(folder: Path, invoke: Invoke) -> None:
    refused = invoke("safe", "pendulum")
    assert refused.exit_code == 2
    assert_names(refused.stderr, "pendulum")
