"""Misuse in good faith: thresholds chosen after looking, and campaigns chosen among several."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from conftest import make_validation
from ctxval import Campaign, Store, Verdict, searches
from ctxval.campaign.storage.other_stores import provenance_of_store
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.cli import app
from ctxval.errors import ForeignStoreError
from ctxval.report.context import context_of_campaign
from facts import assert_names, refuses
from rig_thorough import more

BY = CertificateOptions(DistanceBound(resolution=1.0))
LOOKED = "the threshold was stated after"


def campaign(store: Path | None = None, seed: int = 0, **options: Any) -> Campaign:
    return Campaign(make_validation(), search=searches.GPUCB(), store=store, seed=seed, **options)


def judged(made: Campaign, threshold: float) -> Verdict:
    return made.verdict(threshold, certificate=BY)


def test_a_threshold_that_was_stated_first_is_no_remark() -> None:
    made = campaign().run(7, 50.0, explore=True)
    verdict = judged(made, 50.0)
    assert verdict.answer == "validated"
    assert LOOKED not in str(verdict)
    assert "chosen to suit" not in str(verdict)
    assert [(each.threshold, each.distances) for each in made.store.thresholds() or ()] == [(50.0, 0)]


@pytest.mark.parametrize("in_memory", [False, *more(True)])
def test_a_threshold_chosen_after_looking_is_said_once_and_for_all(tmp_path: Path, in_memory: bool) -> None:
    store = None if in_memory else tmp_path / "a.sqlite"
    made = campaign(store).run(6)
    verdict = judged(made, 50.0)
    assert verdict.answer == "validated"
    assert_names(verdict.reason, "stated", 6)
    assert verdict.rests_on is not None
    assert_names(verdict.rests_on, 6, "stated", "campaign")
    stated = made.store.thresholds()
    again = made if store is None else campaign(store)
    again.run(7, 50.0, explore=True)
    assert_names(judged(again, 50.0).reason, 6)
    assert again.store.thresholds() == stated


def test_smaller_thresholds_that_failed_before_are_named() -> None:
    made = campaign().run(6)
    worst = made.worst.distance or 0.0  # type: ignore[union-attr]
    assert judged(made, 0.5 * worst).answer == "falsified"
    assert judged(made, worst * (1 + 1e-9)).answer == "undecided"
    reason = judged(made, 50.0).reason
    assert_names(reason, "smaller", "falsified", f"{0.5 * worst:.6g}")
    assert_names(reason, "smaller", "undecided", f"{worst:.6g}")
    assert " 50" not in judged(made, 40.0).reason.split("the threshold was stated")[1]  # it is larger
    # A threshold that was stated before any other has nothing before it.
    first = campaign()
    first.state_threshold(50.0)
    first.run(6)
    judged(first, 0.5 * worst)
    assert "smaller" not in str(judged(first, 50.0))


def test_people_who_execute_state_their_threshold_when_they_ask() -> None:
    made = campaign()
    made.state_threshold(50.0)
    for _ in range(6):
        opened = made.ask()
        made.tell(opened, made.validation.execute(opened.plan))
    assert LOOKED not in str(judged(made, 50.0))
    asked = campaign()
    asked.ask_for_verdict(1e-9, 5)
    assert [each.threshold for each in asked.store.thresholds() or ()] == [1e-9]


def test_a_store_that_keeps_no_thresholds_behaves_as_before(tmp_path: Path) -> None:
    path = tmp_path / "old.sqlite"
    campaign(path).run(6).store.close()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DELETE FROM experiment WHERE key = 'thresholds'")
    made = campaign(path)
    verdict = judged(made, 50.0)
    assert (verdict.answer, made.store.thresholds()) == ("validated", None)
    assert LOOKED not in str(verdict)


@pytest.mark.parametrize("value", ["{}", "[1]", '[{"threshold": -1.0, "distances": 0, "at": ""}]'])
def test_thresholds_that_no_campaign_wrote_are_refused(tmp_path: Path, value: str) -> None:
    path = tmp_path / "a.sqlite"
    campaign(path).store.close()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE experiment SET value = ? WHERE key = 'thresholds'", (value,))
    with refuses(ForeignStoreError, "a.sqlite"):
        Store(path).thresholds()


def test_a_stated_threshold_changes_nothing_that_results_follow_from(tmp_path: Path) -> None:
    made, other = campaign(tmp_path / "a.sqlite").run(3), campaign(tmp_path / "a.sqlite")
    before = made.store.digest(), made.store.signature(), made.store.description(), made.store.history()
    made.state_threshold(2.0)
    assert (made.store.digest(), made.store.signature(), made.store.description(), made.store.history()) == before
    other.tell(other.ask(), failed="it slipped")  # the campaign that was opened before goes on


def test_another_definition_of_the_distance_has_thresholds_of_its_own(tmp_path: Path) -> None:
    made = campaign(tmp_path / "a.sqlite").run(6, 50.0, explore=True)
    distance = made.validation.distance
    made.remeasure(lambda model, system, task: 2.0 * distance(model, system, task))
    assert made.store.thresholds() == ()
    assert_names(judged(made, 50.0).reason, 6)


def invoke(*arguments: str) -> Any:
    return CliRunner().invoke(app, arguments)


def test_what_only_reads_records_no_threshold_and_says_what_holds(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    made = campaign(path).run(6)
    before = path.read_bytes()
    context = context_of_campaign(made, threshold=50.0, certificate=BY)
    assert_names(str(context.verdict), 6)
    certified = invoke("certify", str(path), "--threshold", "50", "--kind", "posterior", "--resolution", "1")
    assert_names(" ".join(certified.stdout.split()), "threshold", 6)
    assert invoke("report", str(path), "--threshold", "50").exit_code == 0
    assert invoke("status", str(path)).exit_code == 0
    assert path.read_bytes() == before
    made.state_threshold(50.0)
    assert_names(invoke("status", str(path)).stdout, "threshold", 50, 6)


def test_the_campaigns_of_one_experiment_are_counted_together(tmp_path: Path) -> None:
    worst = []
    for seed in (1, 2):
        beside = campaign(tmp_path / f"seed{seed}.sqlite", seed).run(5)
        worst.append(beside.worst.distance)  # type: ignore[union-attr]
    made = campaign(tmp_path / "a.sqlite")
    assert [other.path.name for other in provenance_of_store(made.store).beside] == []  # nothing is executed here yet
    made.run(6, 50.0, explore=True)
    beside = provenance_of_store(made.store).beside
    assert [(other.path.name, other.worst and other.worst.distance) for other in beside] == [
        ("seed1.sqlite", worst[0]),
        ("seed2.sqlite", worst[1]),
    ]
    rests_on = str(judged(made, 50.0).rests_on)
    several = "this campaign not being chosen among several"
    assert_names(rests_on, "beside", "falsifies", several)
    assert [other.falsifies(min(worst) * 0.99) for other in beside] == [True, True]  # type: ignore[operator]
