"""One unreadable trial is set aside, and the campaign goes on with the others."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ctxval import Campaign, Store, TaskSpace, TaskSuite, Validation
from ctxval.campaign.storage.rows import COLUMNS, checksum_of
from ctxval.campaign.storage.setting_aside import set_aside
from ctxval.cli import app
from ctxval.controllers import LQR
from ctxval.core.task import Task
from ctxval.distances import MaximumDeviation
from ctxval.errors import ForeignStoreError
from ctxval.models import Linear
from ctxval.searches import Random
from ctxval.systems import Simulated
from facts import refuses

SPACES = {
    "box": TaskSpace(goal=(0.5, 3.0, "m"), push=([0.0, -0.1], [0.4, 0.1])),
    "suite": TaskSuite({"near": {"goal": 1.0}, "far": {"goal": 3.0}, "further": {"goal": 4.0}}),
}


def validation(space: TaskSpace) -> Validation:
    model = Linear(A=[[1.0, 0.1], [0.0, 1.0]], B=[[0.0], [0.1]])
    return Validation(
        space=space,
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=10, dt=0.1),
        system=Simulated(lambda x, u: model.step(x, u) * 0.99),
        model=model,
        synthesizer=LQR(Q=[1.0, 0.1], R=[0.1]),
        distance=MaximumDeviation(scales=[1.0, 1.0]),
    )


def executed(path: Path, kind: str = "box") -> list[float | None]:
    campaign = Campaign(validation(SPACES[kind]), search=Random(), store=path)
    campaign.run(3)
    campaign.store.close()
    return [trial.distance for trial in campaign.trials]


def damage(path: Path, statement: str, *values: Any) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(statement, values)


def stored_row(path: Path) -> Any:
    with closing(sqlite3.connect(path)) as connection:
        connection.text_factory = lambda text: text.decode("utf-8", "backslashreplace")
        return connection.execute(f"SELECT {COLUMNS}, checksum FROM trials WHERE number = 1").fetchone()


DAMAGES = {
    "distance": "UPDATE trials SET distance = distance + 1 WHERE number = 1",
    "null distance": "UPDATE trials SET distance = NULL WHERE number = 1",
    "no UTF-8": "UPDATE trials SET origin = CAST(x'80ff' AS TEXT) WHERE number = 1",
    "attempts": "UPDATE trials SET attempts = 9223372036854775807 WHERE number = 1",
    "point": "UPDATE trials SET unit_point = '[NaN, NaN, NaN]' WHERE number = 1",
    "task": "UPDATE trials SET unit_point = '[NaN]', parameters = '{}' WHERE number = 1",
    "everything": "UPDATE trials SET unit_point = x'00', parameters = 3, note = '[', state = x'ff', executed = 'no', "
    "origin = 1, attempts = 'x', distance = 'far', failure = 5, seconds = 'y', because = x'00' WHERE number = 1",
}


@pytest.mark.parametrize("kind", SPACES)
@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_trial_is_measured_again_and_nothing_is_deleted(tmp_path: Path, name: str, kind: str) -> None:
    path = tmp_path / "a.sqlite"
    before = executed(path, kind)
    damage(path, DAMAGES[name])
    row = stored_row(path)
    with refuses(ForeignStoreError, "--set-aside", 1):
        Store(path).trials()
    result = CliRunner().invoke(app, ["status", str(path), "--set-aside", "1", "--json"])
    assert result.exit_code == 0
    lost = name in ("task", "everything")  # a task that cannot be read may not have a distance
    assert json.loads(result.stdout)["unmeasured"] == ([] if lost else [1])
    (change,) = Store(path).history()
    assert change.content["row"] == dict(zip([*COLUMNS.split(", "), "checksum"], map(repr, row), strict=True))
    campaign = Campaign(validation(SPACES[kind]), store=path)
    campaign.remeasure()
    after = [trial.distance for trial in campaign.trials]
    assert after == [before[0], None if lost else before[1], before[2]]
    if kind == "box":
        campaign.run(4)
        assert campaign.executions == 4


def test_a_damaged_trial_without_a_trajectory_is_a_failed_execution(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    executed(path)
    damage(path, "DELETE FROM trajectories WHERE trial = 1 AND side = 'system'")
    damage(path, DAMAGES["distance"])
    set_aside(Store(path), 1)
    trial = Store(path).trials()[1]
    assert (trial.state, trial.executed, trial.distance) == ("failed", True, None)


@pytest.mark.parametrize("side", ["model", "system"])
def test_a_damaged_trajectory_is_taken_out_of_its_trial(tmp_path: Path, side: str) -> None:
    path = tmp_path / "a.sqlite"
    before = executed(path)
    damage(path, "UPDATE trajectories SET npz = x'504b0506ff' WHERE trial = 1 AND side = ?", side)
    store = Store(path)
    with refuses(ForeignStoreError, "--set-aside", 1):
        store.trajectory(1, side)  # type: ignore[arg-type]
    set_aside(store, 1)
    assert store.trajectory(1, side) is None  # type: ignore[arg-type]
    assert [trial.distance for trial in store.trials()] == before
    assert store.history()[0].content["npz"] == {side: "UEsFBv8="}
    assert Campaign(validation(SPACES["box"]), store=path).verdict(10.0).answer == "undecided"


@pytest.mark.parametrize("number", [0, 7, -1])
def test_a_readable_or_missing_trial_is_not_set_aside(tmp_path: Path, number: int) -> None:
    path = tmp_path / "a.sqlite"
    executed(path)
    content = path.read_bytes()
    result = CliRunner().invoke(app, ["status", str(path), "--set-aside", str(number)])
    assert (result.exit_code, path.read_bytes()) == (2, content)


def test_a_row_of_another_version_with_minus_zero_is_measured_again(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    executed(path)
    *row, _ = stored_row(path)
    row[COLUMNS.split(", ").index("distance")] = -0.0
    damage(path, "UPDATE trials SET distance = -0.0, checksum = ? WHERE number = 1", checksum_of(tuple(row)))
    with pytest.raises(ForeignStoreError):
        Store(path).trials()
    set_aside(Store(path), 1)
    assert [trial.state for trial in Store(path).trials()] == ["completed", "unmeasured", "completed"]
