"""Suites of tasks on the command line: run, ask, tell, import, and what is printed of their tasks."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from ctxval.campaign.storage.store import Store
from facts import assert_names
from rig_cli import calling, report

pytestmark = pytest.mark.slow

FILE = """
name = "carts"
threshold = 2.0
budget = 3
units = "m"

[suite]
"short way" = { goal = 0.5 }
"long way" = { goal = 1.0 }
back = { goal = -1.0 }

[task]
initial_state = [0.0, 0.0]
goal = ["goal", 0.0]
horizon = 20
dt = 0.1

[model]
type = "Linear"
A = [[1.0, 0.1], [0.0, 0.97]]
B = [[0.0], [0.1]]

[synthesizer]
type = "LQR"
Q = [1.0, 0.1]
R = [0.1]

[distance]
type = "MaximumDeviation"
components = [0]
"""
SIMULATED = """
[system]
type = "Simulated"
step = { ref = "cart_of_a_suite:step" }
"""
MODULE = """
import numpy as np

def step(x, u):
    return np.array([x[0] + 0.1 * x[1], 0.93 * x[1] + 0.1 * u[0]])
"""
BY_HAND = '[system]\ntype = "Manual"\nstates = { position = "m", speed = "m/s" }\ninputs = { force = "N" }\ndt = 0.1\n'


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "carts.toml"
    path.write_text(FILE + SIMULATED)
    (tmp_path / "cart_of_a_suite.py").write_text(MODULE)
    return path


@pytest.fixture
def by_hand(tmp_path: Path) -> Path:
    path = tmp_path / "hand.toml"
    path.write_text(FILE + BY_HAND)
    return path


def test_a_suite_is_run_to_its_verdict_and_reported_by_the_names_of_its_tasks(file: Path, tmp_path: Path) -> None:
    store = str(tmp_path / "carts.sqlite")
    done = calling()("run", str(file), "--store", store)
    assert done.exit_code == 0, done.output
    assert "task='long way'" in done.output
    assert_names(" ".join(done.output.split()), "all", 3, "suite")
    assert report(calling()("certify", store, "--kind", "suite", "--json"))["kind"] == "suite"
    page = Path(store).with_suffix(".report.html").read_text()
    assert all(name in page for name in ("short way", "long way", "back"))
    assert_names(page, 3, "suite")
    assert_names(report(calling()("check", str(file), "--json"))["findings"][0]["text"], 3)
    refused = calling()("certify", store, "--kind", "posterior")
    assert_names(" ".join((refused.stdout + refused.stderr).split()), "suite")


def test_people_execute_a_suite(by_hand: Path, tmp_path: Path) -> None:
    store, call = str(tmp_path / "hand.sqlite"), calling()
    first = report(call("ask", str(by_hand), "--store", store, "--set", "task=long way", "--json"))
    assert first["task"] == {"task": "long way"}
    assert report(call("tell", store, "0", "--distance", "0.4", "--json"))["task"] == {"task": "long way"}
    left = [report(call("ask", str(by_hand), "--store", store, "--json"))["task"]["task"] for _ in range(2)]
    assert set(left) == {"short way", "back"}
    refused = call("ask", str(by_hand), "--store", store, "--budget", "9")
    assert_names(" ".join(refused.output.split()), "task")
    unknown = call("ask", str(by_hand), "--store", store, "--set", "task=long")
    assert_names(" ".join(unknown.stderr.split()), "long way")
    unnamed = call("ask", str(by_hand), "--store", store, "--set", "goal=1.0")
    assert "as task=NAME, got 'goal=1.0'" in " ".join(unnamed.stderr.split())


def test_runs_of_a_suite_are_imported(by_hand: Path, tmp_path: Path) -> None:
    with (tmp_path / "runs.csv").open("w", newline="") as written:
        csv.writer(written).writerows([["task", "distance"], ["back", 0.2], ["long way", 0.3]])
    store, call = str(tmp_path / "hand.sqlite"), calling()
    report(call("ask", str(by_hand), "--store", store, "--set", "task=short way", "--json"))
    done = call("import", store, str(tmp_path / "runs.csv"))
    assert done.exit_code == 0, done.output
    trials = Store.existing(store).trials()[1:]
    assert [(trial.parameters["task"], trial.distance) for trial in trials] == [("back", 0.2), ("long way", 0.3)]
    assert np.array_equal([trial.unit_point[0] for trial in trials], [0.0, 1.0])


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (("[task]", "[space]\ngoal = [0.0, 1.0]\n\n[task]"), ()),
        (("back = { goal = -1.0 }", "back = { aim = -1.0 }"), ()),
        (("back = { goal = -1.0 }", "back = { goal = [1.0] }"), ([1.0],)),
    ],
)
def test_a_file_with_a_wrong_suite_is_refused(file: Path, change: tuple[str, str], facts: tuple[object, ...]) -> None:
    file.write_text(file.read_text().replace(*change))
    refused = calling()("check", str(file))
    assert refused.exit_code == 2
    assert_names(" ".join(refused.stderr.split()), *facts)
