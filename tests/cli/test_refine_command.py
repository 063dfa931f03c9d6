"""``ctxval refine``, as users call it."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

from ctxval import Store, models
from facts import assert_names
from rig_cli import SMALL, Invoke, calling

PLANT = """
import time
import numpy as np

def step(x, u):
    return np.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - 0.5 * x[1] - 0.3 * x[1] * abs(x[1]))])

def law(x, u, theta):
    return np.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - theta[0] * x[1] - theta[1] * x[1] * abs(x[1]))])

def broken(data):
    raise RuntimeError("no convergence")

def network(data):
    from ctxval import models
    return models.GaussianProcessModel.fit(data, 100)
"""

FILE = """
name = "cart"
budget = {budget}
threshold = 0.05
units = "m"
[space]
goal = [0.5, 2.0, "m"]
[task]
initial_state = [0.0, 0.0]
goal = ["goal", 0.0]
horizon = 30
dt = 0.1
[states]
position = "m"
speed = "m/s"
[inputs]
force = "N"
[system]
type = "Simulated"
step = {{ ref = "refined_plant:step" }}
[model]
type = "Linear"
A = [[1.0, 0.1], [0.0, 1.0]]
B = [[0.0], [0.1]]
[synthesizer]
type = "LQR"
Q = [1.0, 0.1]
R = [0.1]
[distance]
type = "MaximumDeviation"
components = [0]
[search]
type = "auto"
thinking = "fast"
"""


def prepare(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Write an experiment and its module to a folder, and go there."""
    patch.chdir(folder)
    patch.setenv("COLUMNS", "160")
    sys.modules.pop("refined_plant", None)
    (folder / "refined_plant.py").write_text(PLANT)
    (folder / "cart.toml").write_text(FILE.format(budget=20))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    prepare(tmp_path, monkeypatch)
    return tmp_path


@pytest.fixture
def invoke(folder: Path) -> Invoke:
    return calling()


def falsified(invoke: Invoke) -> str:
    """Return a store of a falsified model with one execution."""
    store = "cart.sqlite"
    assert invoke("run", "cart.toml", "--budget", "1", "--store", store, "--no-report").exit_code == 1
    return store


@pytest.mark.slow
@pytest.mark.thorough
def test_a_falsified_store_is_refined_until_the_model_is_validated(invoke: Invoke, folder: Path) -> None:
    pytest.importorskip("onnxruntime")
    store = falsified(invoke)
    done = invoke("refine", store, "--budget", "20", "--out", "better.onnx", "--json")
    assert done.exit_code == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert (found["verdict"], found["threshold"], found["rounds"][0]["verdict"]) == ("validated", 0.05, "falsified")
    assert found["executions"] == sum(one["executions"] for one in found["rounds"]) <= 20
    assert found["distance_before"] > 0.05 > found["distance_after"]
    assert found["files"] == ["better.onnx", "better.data.npz", "better.residual.json", "better.residual.txt"]
    assert found["residual"]["guaranteed"] is False
    assert models.Onnx("better.onnx").network.widths == (3,)
    # The store of a round is a store like any other.
    certified = invoke("certify", "cart.round-1.sqlite", "--kind", "dynamics", "--threshold", "0.05", "--json")
    assert certified.exit_code == 0, certified.stdout + certified.stderr
    assert json.loads(certified.stdout)["trials"] == found["rounds"][1]["executions"]
    # The same command again resumes: nothing is executed.
    again = json.loads(invoke("refine", store, "--budget", "20", "--json").stdout)
    assert {**again, "files": found["files"]} == found


REFINE = ("refine", "cart.toml", "--seed", "1", "--confidence", "0.9")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    """What an unbroken refinement prints, and its folder."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        prepare(folder, patch)
        return calling()(*REFINE), folder


@pytest.mark.slow
def test_an_experiment_is_run_first_and_the_answer_is_said(whole: tuple[Result, Path]) -> None:
    done, folder = whole
    assert done.exit_code == 0, done.stdout + done.stderr
    for facts in (("falsified",), (0.05,), (), (0.95,), ()):
        assert_names(" ".join(done.stdout.split()), *facts)
    assert (folder / "runs" / "cart-auto-seed1.round-1.sqlite").exists()


@pytest.mark.slow
@pytest.mark.thorough
def test_parameters_of_a_function_are_estimated_and_written(invoke: Invoke) -> None:
    store = falsified(invoke)
    given = ("--step", "refined_plant:law", "--parameter", "linear=[0, 2]", "--parameter", "square=[0, 2]")
    done = invoke("refine", store, "--method", "parameters", *given, "--out", "law.toml", "--budget", "3", "--json")
    assert done.exit_code == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert [round(one["value"], 6) for one in found["parameters"]] == [0.5, 0.3]
    assert 'type = "Parametric"' in Path("law.toml").read_text()


@pytest.mark.thorough
def test_a_function_of_the_user_learns_the_model(invoke: Invoke) -> None:
    store = falsified(invoke)
    done = invoke("refine", store, "--method", "fit", "--fit", "refined_plant:network", "--budget", "4", "--json")
    assert done.exit_code in (0, 1), done.stdout + done.stderr
    assert json.loads(done.stdout)["rounds"][1]["method"] == "fit"


@pytest.mark.thorough
def test_a_killed_refinement_loses_nothing_and_ends_as_an_unbroken_one(
    whole: tuple[Result, Path], invoke: Invoke, folder: Path
) -> None:
    quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    killed = subprocess.Popen([*SMALL, *REFINE], cwd=folder, **quiet)
    stores = folder / "runs"
    deadline = time.monotonic() + 300
    while executions(stores) < 2 and killed.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    before = trials(stores)
    assert invoke(*REFINE).exit_code == 0
    after = trials(stores)
    assert after == trials(whole[1] / "runs")
    assert all(one in after for one in before if one[2] == "completed")


def executions(folder: Path) -> int:
    try:
        return sum(len(trials(folder, path)) for path in folder.glob("*.round-*.sqlite"))
    except sqlite3.Error:
        return 0


def trials(folder: Path, only: Path | None = None) -> list[Any]:
    found = []
    for path in [only] if only else sorted(folder.glob("*.sqlite")):
        with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as connection:
            rows = connection.execute("SELECT number, unit_point, state, distance FROM trials").fetchall()
        connection.close()
        found += [(path.name, *row) for row in rows]
    return [(name, point, state, distance) for name, _, point, state, distance in found]


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["none.sqlite"], ("none.sqlite",)),
        (["cart.toml", "--budget", "0"], ("budget", 0)),
        (["cart.toml", "--method", "residul"], ("residual",)),
        (["cart.toml", "--method", "fit"], ("--method", "--fit", "MODULE", "ATTR")),
        (["cart.toml", "--fit", "refined_plant:broken"], ()),
        (["cart.toml", "--method", "parameters"], ("--parameter",)),
        (["cart.toml", "--step", "refined_plant:law"], ("--step", "--method", "parameters")),
        (["cart.toml", "--out", "model.pkl"], ()),
        (["cart.toml", "--out", "cart.toml/model.npz"], ("cart.toml", "model.npz")),
        (["cart.toml", "--out", "model.toml"], ("residual",)),
        (["cart.toml", "--method", "network", "--out", "a.toml"], ()),
        (
            ["cart.toml", "--method", "parameters", "--parameter", "a=[0, 1]", "--out", "a.onnx"],
            ("parameters",),
        ),
        (
            ["cart.toml", "--method", "parameters", "--parameter", "a=[0, 1]", "--out", "a.toml"],
            ("--step",),
        ),
        (
            ["better.npz"],
            ("better.npz",),
        ),
        (["refined_plant.py"], ("refined_plant",)),
        (["cart.toml", "--trust"], ("--experiment", "--trust")),
        (["cart.toml", "--threshold", "-1"], ("threshold",)),
        (["cart.sqlite", "--seed", "1"], ()),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(
    invoke: Invoke, arguments: list[str], facts: tuple[object, ...]
) -> None:
    done = invoke("refine", *arguments)
    assert done.exit_code == 2, done.stdout + done.stderr
    assert_names(" ".join(done.stderr.split()), *facts)
    assert not list(Path().rglob("*.round-*"))
    assert not any(Store(path).trials() for path in Path().rglob("*.sqlite"))


def test_a_correction_of_a_function_cannot_be_onnx_and_is_refused_before_executions(invoke: Invoke) -> None:
    pytest.importorskip("onnx")
    described = FILE.format(budget=20)
    table = '[model]\ntype = "refined_plant:step"\n'
    start, end = described.index("[model]"), described.index("[synthesizer]")
    Path("cart.toml").write_text(described[:start] + table + described[end:])
    done = invoke("refine", "cart.toml", "--out", "better.onnx")
    assert done.exit_code == 2, done.stdout + done.stderr
    assert_names(" ".join(done.stderr.split()), "ONNX")
    assert not any(Store(path).trials() for path in Path().rglob("*.sqlite"))


def test_a_fit_that_fails_is_said_and_nothing_is_lost(invoke: Invoke) -> None:
    store = falsified(invoke)
    done = invoke("refine", store, "--method", "fit", "--fit", "refined_plant:broken", "--budget", "9")
    assert done.exit_code == 2
    assert_names(" ".join(done.stderr.split()), "fit", "RuntimeError")
    assert len(Store(store).trials()) == 1


def test_a_store_without_trajectories_is_refused(invoke: Invoke) -> None:
    store = falsified(invoke)
    with sqlite3.connect(store) as connection:  # as in a store whose distances were told without recordings
        connection.execute("DELETE FROM trajectories")
    connection.close()
    done = invoke("refine", store, "--budget", "9")
    assert done.exit_code == 2


def test_a_store_of_another_experiment_is_refused(invoke: Invoke) -> None:
    store = falsified(invoke)
    Path("other.toml").write_text(FILE.format(budget=20).replace("[0.5, 2.0", "[0.5, 3.0"))
    done = invoke("refine", store, "--experiment", "other.toml", "--budget", "9")
    assert done.exit_code == 2
    assert "space" in done.stderr
