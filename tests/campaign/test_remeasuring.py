"""A rig's afternoon is not lost to a changed question: distances anew, through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from ctxval import Store
from ctxval.cli import app
from ctxval.cli.config.settings import read_settings
from ctxval.core.rollout import rollout
from facts import assert_names

RIG = """
name = "rig"
threshold = 0.5
units = "m"
[space]
goal = [0.5, 2.0, "m"]
[task]
initial_state = [0.0, 0.0]
goal = ["goal", 0.0]
horizon = 20
dt = 0.1
[system]
type = "Manual"
states = { position = "m", speed = "m/s" }
inputs = { force = "N" }
dt = 0.1
[model]
type = "Linear"
A = [[1.0, 0.1], [0.0, 1.0]]
B = [[0.0], [0.1]]
[synthesizer]
type = "LQR"
Q = [10.0, 1.0]
R = [0.1]
limits = 3.0
[distance]
type = "FinalState"
norm = 2
weights = [1, 1]
"""


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(RIG)
    return lambda *arguments: CliRunner().invoke(app, list(arguments))


def answer(result: Result, status: int = 0) -> dict[str, Any]:
    assert result.exit_code == status, result.stderr
    report: dict[str, Any] = json.loads(result.stdout)
    return report


def execute_by_hand(invoke: Any, goal: float) -> None:
    """Take a task, do what a rig with some friction does, and tell it."""
    target = ["a.sqlite"] if Path("a.sqlite").exists() else ["rig.toml", "--store", "a.sqlite"]
    asked = answer(invoke("ask", *target, "--set", f"goal={goal:.6f}", "--json"))
    settings = read_settings("rig.toml", {})
    plan = settings.load().validation.plan([asked["task"]["goal"]])

    def step(x: Any, u: Any) -> Any:
        speed = x[..., 1] + 0.1 * (u[..., 0] - 0.2 * x[..., 1])
        return np.stack([x[..., 0] + 0.1 * x[..., 1], speed], axis=-1)

    rollout(step, plan.controller, plan.task).to_csv("run.csv")
    answer(invoke("tell", "a.sqlite", str(asked["trial"]), "--trajectory", "run.csv", "--json"))


@pytest.mark.thorough
def test_a_distance_changed_after_ten_executions_is_decided_without_an_eleventh(invoke: Any) -> None:
    for goal in np.linspace(0.5, 2.0, 10):
        execute_by_hand(invoke, goal)
    before = [trial.distance for trial in Store("a.sqlite").trials()]
    Path("rig.toml").write_text(RIG.replace("norm = 2\nweights = [1, 1]", "norm = 1\ncomponents = [0]"))
    refused = invoke("ask", "rig.toml", "--store", "a.sqlite")
    assert refused.exit_code == 2
    assert "ctxval remeasure STORE --experiment" in refused.stderr
    assert answer(invoke("remeasure", "a.sqlite", "--json"))["changed"] == []
    assert_names(invoke("remeasure", "a.sqlite").stdout, "--experiment")
    report = answer(invoke("remeasure", "a.sqlite", "--experiment", "rig.toml", "--json"))
    assert (report["measured"], report["changed"], report["unmeasured"]) == (10, list(range(10)), [])
    after = Store("a.sqlite").trials()
    assert all(0 <= (t.distance or 0) < (d or 0) for t, d in zip(after, before, strict=True))
    verdict = answer(invoke("certify", "a.sqlite", "--json"))
    assert (verdict["verdict"], verdict["trials"]) == ("validated", 10)
    status = answer(invoke("status", "a.sqlite", "--json"))
    assert status["executions"] == 10
    (change,) = status["changes"]
    assert [change["content"]["before"][str(n)]["distance"] for n in range(10)] == before
    assert "remeasured" in invoke("status", "a.sqlite").stdout


def test_a_repair_goes_on_with_a_reason_that_the_store_keeps(invoke: Any) -> None:
    execute_by_hand(invoke, 1.0)
    Path("rig.toml").write_text(RIG.replace('force = "N"', 'force = "kN"'))
    refused = invoke("ask", "rig.toml", "--store", "a.sqlite", "--set", "goal=1.5")
    assert refused.exit_code == 2
    assert "--accept-change" in refused.stderr
    accepted = ("ask", "rig.toml", "--store", "a.sqlite", "--set", "goal=1.5", "--accept-change", "amplifier replaced")
    answer(invoke(*accepted, "--json"))
    assert_names(invoke("status", "a.sqlite").stdout, "accepted")
