"""``ctxval certify`` with kinds that need the experiment's model: on real stores, as text and JSON, and their trust."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from ctxval.cli import app
from ctxval.cli.config import trust
from facts import assert_names

pytestmark = pytest.mark.slow


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the pendulum with six trials of the search."""
    store = tmp_path_factory.mktemp("runs") / "pendulum.sqlite"
    searched = ("run", "pendulum", "--search", "gp-ucb", "--explore", "--budget", "6", "--no-report")
    assert invoke(*searched, "--store", str(store)).exit_code == 0
    return store


@pytest.fixture(scope="module")
def stored(searched: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same store with thirty independent draws."""
    store = Path(shutil.copy(searched, tmp_path_factory.mktemp("audited") / "pendulum.sqlite"))
    assert invoke("certify", str(store), "--audit", "30").exit_code == 0
    return store


@pytest.fixture
def store(stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    shutil.copy(stored, tmp_path / "a.sqlite")
    monkeypatch.chdir(tmp_path)
    return "a.sqlite"


@pytest.mark.thorough
def test_a_counterexample_stands_beside_the_map(store: str) -> None:
    result = invoke("certify", store, "--kind", "dynamics", "--threshold", "0.2", "--json")
    report = json.loads(result.stdout)
    assert result.exit_code == 1
    assert report["verdict"] == "falsified"
    assert 0 < report["details"]["share_kept"] < 1
    assert report["volume"] > 1 - report["details"]["share_kept"]


FILE = """
name = "rotor"
[space]
target = [-1.0, 1.0]
[task]
initial_state = [0.0]
goal = ["target"]
horizon = 20
dt = 0.05
[system]
type = "Simulated"
step = { ref = "rotor_parts:step" }
[model]
type = "Linear"
A = [[1.0]]
B = [[0.05]]
[synthesizer]
type = "LQR"
Q = [1.0]
R = [0.1]
"""

PARTS = """
import numpy as np


def step(x, u):
    return np.array([x[0] + 0.05 * (u[0] - np.sin(x[0]))])
"""


RUN = ("run", "rotor.toml", "--budget", "4", "--store", "r.sqlite", "--search", "cma-es", "--no-report")


def test_options_are_given_by_name_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("option_parts.py").write_text(PARTS)
    Path("rotor.toml").write_text(FILE.replace("rotor_parts", "option_parts"))
    assert invoke(*RUN).exit_code == 0
    assert invoke("certify", "r.sqlite", "--audit", "12").exit_code == 0
    assert invoke("certify", "r.sqlite", "--kind", "posterior", "--option", "resolution=0.3").exit_code != 2
    refused = invoke("certify", "r.sqlite", "--kind", "audit", "--option", "tests=3")
    assert refused.exit_code == 2
    assert_names(refused.stderr, "tests", "auto", "dynamics")


def test_code_of_another_user_is_asked_about_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("rotor_parts.py").write_text(PARTS)
    Path("rotor.toml").write_text(FILE)
    run = invoke(*RUN)
    assert run.exit_code == 0, run.output
    assert invoke("certify", "r.sqlite", "--audit", "12").exit_code == 0
    own = invoke("certify", "r.sqlite", "--kind", "dynamics")
    assert own.exit_code == 0, own.output
    shutil.rmtree(trust.allowed_folder())  # as if another user had made the store
    assert invoke("certify", "r.sqlite", "--kind", "audit").exit_code == 0  # runs no code
    foreign = invoke("certify", "r.sqlite", "--kind", "dynamics")
    assert foreign.exit_code == 2
    assert_names(foreign.stderr, "--trust")
    named = invoke("certify", "r.sqlite", "--kind", "dynamics", "--experiment", "rotor.toml")
    assert named.exit_code == 0, named.output


def test_a_store_made_in_python_asks_for_its_experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from conftest import make_validation
    from ctxval import Campaign, searches

    monkeypatch.chdir(tmp_path)
    Campaign(make_validation(), search=searches.Random(), store="own.sqlite").run(12)
    refused = invoke("certify", "own.sqlite", "--kind", "dynamics")
    assert refused.exit_code == 2
    assert_names(" ".join(refused.stderr.split()), "--experiment", "FILE.toml")
