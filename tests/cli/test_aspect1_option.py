"""``ctxval check --aspect1``: whether the model itself completes the tasks."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ctxval.cli import app
from facts import assert_names

pytestmark = pytest.mark.usefixtures("without_costs")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, ["init", "cart.toml"]).exit_code == 0
    yield tmp_path
    sys.modules.pop("cart_system", None)


def checked(*arguments: str, status: int = 0) -> dict[str, Any]:
    done = CliRunner().invoke(app, ["check", "cart.toml", "--aspect1", "--json", *arguments])
    assert done.exit_code == status, done.output
    return json.loads(done.stdout)


def texts(report: dict[str, Any]) -> dict[str, tuple[str, str]]:
    return {one["check"]: (one["state"], one["text"]) for one in report["findings"]}


def test_a_model_that_completes_its_tasks_exits_with_0() -> None:
    report = checked("--tasks", "20", "--threshold", "0.2")
    assert report["ok"]
    found = report["aspect1"]
    assert found["completes"] is True
    assert found["tasks"] == 20
    assert found["threshold"] == 0.2
    assert found["distance"] == "GoalError(norm=2, components=[0])"
    state, text = texts(report)["tasks on the model"]
    assert state == "ok"
    assert_names(text, "completes", 20, "tasks")
    assert_names(text, 0.95, 25.9, "tasks")
    assert texts(report)["limits of the inputs"][0] in ("ok", "noted")
    assert texts(report)["convergence of the designs"][0] == "skipped"


def test_a_model_that_does_not_exits_as_falsified_and_names_the_worst_task() -> None:
    report = checked("--tasks", "20", "--threshold", "1e-6", status=1)
    assert not report["ok"]
    assert report["aspect1"]["completes"] is False
    assert report["aspect1"]["verdict"] == "falsified"
    assert set(report["aspect1"]["worst"]["parameters"]) == {"goal", "start_speed"}
    state, text = texts(report)["tasks on the model"]
    assert state == "failed"
    assert_names(text, 20, 1e-06, "worst", "goal")


@pytest.mark.thorough
def test_people_read_the_same_sentences() -> None:
    done = CliRunner().invoke(app, ["check", "cart.toml", "--aspect1", "--tasks", "8"])
    assert done.exit_code == 0
    assert_names(done.output, 8)
    assert "neighbouring tasks" in done.output


@pytest.mark.thorough
def test_an_experiment_file_has_a_table_for_it(folder: Path) -> None:
    with (folder / "cart.toml").open("a") as file:
        file.write('[aspect1]\nthreshold = 0.3\ntasks = 12\ndistance = { type = "GoalError", norm = 1 }\n')
    found = checked()["aspect1"]
    assert (found["tasks"], found["threshold"], found["distance"]) == (12, 0.3, "GoalError(norm=1)")
    assert checked("--tasks", "6", "--threshold", "2")["aspect1"]["threshold"] == 2.0
    # A campaign does not use it, so it is no part of a store.
    assert CliRunner().invoke(
        app, ["run", "cart.toml", "--budget", "2", "--store", "a.sqlite", "--no-report"]
    ).exit_code in (0, 1)
    assert b"aspect1" not in (folder / "a.sqlite").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--tasks", "5"], "--tasks needs --aspect1"),
        (["--threshold", "0.1"], "--threshold needs --aspect1"),
        (["--aspect1", "--threshold", "-1"], "threshold"),
    ],
)
def test_nonsense_is_refused_in_a_sentence(arguments: list[str], said: str) -> None:
    done = CliRunner().invoke(app, ["check", "cart.toml", *arguments])
    assert done.exit_code == 2
    assert said in done.output
    assert "Traceback" not in done.output


def test_a_wrong_table_is_named(folder: Path) -> None:
    with (folder / "cart.toml").open("a") as file:
        file.write("[aspect1]\ntasks = 1\n")
    done = CliRunner().invoke(app, ["check", "cart.toml", "--aspect1"])
    assert done.exit_code == 2
    assert "aspect1.tasks" in done.output
