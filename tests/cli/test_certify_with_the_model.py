"""``ctxval certify`` with kinds that need the experiment's model: on real stores, as text and JSON, and their trust."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from ctxval import Store
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
def test_an_audit_for_a_region_is_drawn_and_certified_in_one_command(searched: Path, tmp_path: Path) -> None:
    store = str(shutil.copy(searched, tmp_path / "a.sqlite"))
    arguments = (
        "certify",
        store,
        "--kind",
        "region",
        "--audit",
        "30",
        "--threshold",
        "0.5",
        "--volume",
        "0.15",
        "--json",
    )
    result = invoke(*arguments)
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert (report["verdict"], report["kind"], report["trials"]) == ("validated", "region", 30)
    assert report["details"]["learned_before"] == 6
    assert report["details"]["share_kept"] == 1
    assert 0.09 < report["details"]["volume_of_draws"] < report["volume"] < 0.15
    assert report["upper_bound"] == 0.5


@pytest.mark.thorough
def test_a_region_speaks_to_a_person_and_executes_nothing(store: str) -> None:
    before = Store.existing(Path(store)).trials()
    text = " ".join(invoke("certify", store, "--kind", "region", "--threshold", "0.38").stdout.split())
    assert_names(text, "UNDECIDED", 0.38, "region", 30)
    assert_names(text, "region", 95)
    assert_names(text, 0.38)
    assert_names(text, "trials", "before")
    assert len(Store.existing(Path(store)).trials()) == len(before) == 36


@pytest.mark.thorough
def test_a_counterexample_stands_beside_the_map(store: str) -> None:
    result = invoke("certify", store, "--kind", "region", "--threshold", "0.2", "--json")
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
    options = ("--discard", "2", "--option", "predictions=50")
    found = json.loads(invoke("certify", "r.sqlite", "--kind", "region", *options, "--json").stdout)
    assert (found["details"]["discarded"], found["details"]["predictions"]) == (2, 50)
    refused = invoke("certify", "r.sqlite", "--kind", "region", "--option", "tests=3")
    assert refused.exit_code == 2
    assert_names(refused.stderr, "tests", "auto", "dynamics")


def test_code_of_another_user_is_asked_about_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("rotor_parts.py").write_text(PARTS)
    Path("rotor.toml").write_text(FILE)
    run = invoke(*RUN)
    assert run.exit_code == 0, run.output
    assert invoke("certify", "r.sqlite", "--audit", "12").exit_code == 0
    own = invoke("certify", "r.sqlite", "--kind", "region")
    assert own.exit_code == 0, own.output
    shutil.rmtree(trust.allowed_folder())  # as if another user had made the store
    assert invoke("certify", "r.sqlite", "--kind", "audit").exit_code == 0  # runs no code
    foreign = invoke("certify", "r.sqlite", "--kind", "region")
    assert foreign.exit_code == 2
    assert_names(foreign.stderr, "--trust")
    named = invoke("certify", "r.sqlite", "--kind", "region", "--experiment", "rotor.toml")
    assert named.exit_code == 0, named.output


def test_a_store_made_in_python_asks_for_its_experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from conftest import make_validation
    from ctxval import Campaign, searches

    monkeypatch.chdir(tmp_path)
    Campaign(make_validation(), search=searches.Random(), store="own.sqlite").run(12)
    refused = invoke("certify", "own.sqlite", "--kind", "region")
    assert refused.exit_code == 2
    assert_names(" ".join(refused.stderr.split()), "--experiment", "FILE.toml")


def test_what_was_planned_for_a_kind_holds_although_the_kind_is_named_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("planned_parts.py").write_text(PARTS)
    Path("rotor.toml").write_text(
        f'{FILE.replace("rotor_parts", "planned_parts")}[certificate]\nkind = "region"\ndiscard = 2\n'
    )
    assert invoke(*RUN).exit_code == 0
    assert invoke("certify", "r.sqlite", "--audit", "12").exit_code == 0
    for named in ((), ("--kind", "region")):
        shown = invoke("certify", "r.sqlite", *named, "--json")
        assert json.loads(shown.stdout)["details"]["discarded"] == 2
