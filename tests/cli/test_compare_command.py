"""``ctxval compare``, as users call it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ctxval import Store
from ctxval.cli import app
from ctxval.errors import StoreError
from facts import assert_names
from rig_cli import SMALL, Invoke, calling, report

FILE = """
name = "cart"
units = "m"
[space]
goal = [-2.0, 2.0, "m"]
[task]
initial_state = [0.0, 0.0]
goal = ["goal", 0.0]
horizon = 20
dt = 0.05
[system]
type = "Simulated"
step = { ref = "my_compared_cart:step" }
[model]
type = "Linear"
A = [[1.0, 0.05], [0.0, 1.0]]
B = [[0.0], [0.05]]
[distance]
type = "WholeTrajectory"
norm = inf
components = [0]
[search]
type = "gp-ucb"
[synthesizer]
type = "LQR"
"""

STEP = """
def step(x, u):
    return [x[0] + 0.05 * x[1], x[1] + 0.05 * (u[0] - 0.3 * x[1] * abs(x[1]))]
"""


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Invoke:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.delitem(sys.modules, "my_compared_cart", raising=False)
    Path("my_compared_cart.py").write_text(STEP)
    Path("gentle.toml").write_text(FILE + "Q = [1.0, 1.0]\nR = [1.0]\n")
    Path("stiff.toml").write_text(FILE + "Q = [100.0, 1.0]\nR = [0.1]\n")
    Path("wide.toml").write_text((FILE + "Q = [1.0, 1.0]\nR = [1.0]\n").replace("[-2.0, 2.0", "[-3.0, 2.0"))

    return calling("compare")


@pytest.mark.slow
@pytest.mark.thorough
def test_two_files_are_compared_and_the_result_is_printed(invoke: Invoke) -> None:
    said = invoke("gentle.toml", "stiff.toml", "--question", "mean")
    assert said.exit_code == 0, said.stderr
    assert_names(said.stdout, "gentle", "stiff")
    found: dict[str, Any] = report(invoke("gentle.toml", "stiff.toml", "--question", "mean", "--json"))
    assert found["decided"]
    assert found["rankings"] == {"mean": [["gentle"], ["stiff"]]}
    assert set(found["stores"]) == {"gentle", "stiff"}
    before = found["executions"]
    longer = report(invoke("gentle.toml", "stiff.toml", "--question", "mean", "--budget", "300", "--json"))
    assert longer["executions"] == before  # nothing is executed again
    shown = CliRunner().invoke(app, ["status", found["stores"]["gentle"]])
    assert shown.exit_code == 0


@pytest.mark.slow
def test_candidates_have_names_and_cases_have_options(invoke: Invoke) -> None:
    same = invoke("gentle.toml", "other/gentle.toml")
    assert same.exit_code == 2
    assert_names(same.stderr, "gentle")
    found = invoke("a=pendulum", "b=linear:dim=2", "--budget", "2")
    assert found.exit_code == 2
    assert_names(found.stderr, "b")


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["gentle.toml"], (1,)),
        (["gentle.toml", "wide.toml"], ("gentle", "wide")),
        (["gentle.toml", "stiff.toml", "--question", "best"], ("question", "best", "both")),
        (["gentle.toml", "stiff.toml", "--budget", "0"], ("budget",)),
        (["gentle.toml", "stiff.toml", "--confidence", "0.2"], ()),
        (["gentle.toml", "nothing.toml"], ("nothing.toml",)),
        (["gentle.toml", "stiff.toml", "--largest-possible", "-1"], ()),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_sentence(
    invoke: Invoke, arguments: list[str], facts: tuple[object, ...]
) -> None:
    found = invoke(*arguments)
    assert found.exit_code == 2
    assert_names(" ".join(found.stderr.split()), *facts)
    assert "Traceback" not in found.stderr


def test_candidates_that_cannot_be_compared_leave_no_store(invoke: Invoke) -> None:
    assert invoke("gentle.toml", "wide.toml", "--stores", "refused").exit_code == 2
    assert not list(Path("refused").glob("*"))


def trials(folder: Path) -> dict[str, list[tuple[list[float], float | None, str]]]:
    """Return what the stores of a folder have; those that are being made have nothing."""
    found = {}
    for path in sorted(folder.glob("*.sqlite")):
        try:
            kept = Store(path).trials()
        except StoreError:
            continue
        found[path.stem] = [(one.unit_point.tolist(), one.distance, json.dumps(one.note.to_json())) for one in kept]
    return found


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
@pytest.mark.thorough
def test_a_comparison_that_is_killed_makes_the_same_choices(invoke: Invoke) -> None:
    def arguments(folder: str) -> list[str]:
        return ["gentle.toml", "stiff.toml", "--stores", folder, "--budget", "10", "--json"]

    whole = report(invoke(*arguments("whole")))
    process = subprocess.Popen([*SMALL, "compare", *arguments("parts")], stdout=subprocess.DEVNULL)
    while process.poll() is None and sum(map(len, trials(Path("parts")).values())) < 5:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    parts = report(invoke(*arguments("parts")))
    assert trials(Path("parts")) == trials(Path("whole"))
    assert {**parts, "stores": None} == {**whole, "stores": None}
