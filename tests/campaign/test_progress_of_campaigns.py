"""What a campaign reports while it works."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from conftest import make_validation
from ctxval import Campaign, Validation, grid_truth, search_truth, searches
from ctxval._util.progress import Progress, listening
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.errors import StoreAccessError
from ctxval.gp.ascent import usual_effort
from facts import refuses


def reports_of(work: Callable[[], object]) -> list[Progress]:
    heard: list[Progress] = []
    with listening(heard.append):
        work()
    return heard


def last_of(reports: list[Progress]) -> dict[str, Progress]:
    """Return the last report of each stage."""
    return {report.stage: report for report in reports}


def random_campaign(validation: Validation | None = None, **options: Any) -> Campaign:
    return Campaign(validation or make_validation(), search=searches.Random(), seed=1, **options)


def test_each_trial_that_ends_is_reported() -> None:
    campaign = random_campaign().run(2)
    reports = [report for report in reports_of(lambda: campaign.run(4)) if report.note]
    assert [(report.stage, report.done, report.expected) for report in reports] == [
        ("executions", 3, 4),
        ("executions", 4, 4),
    ]
    last = campaign.trials[-1]
    assert reports[-1].note.split("   ")[0].split() == ["trial", "3"]
    assert f"goal={last.parameters['goal']:.4g} rad" in reports[-1].note
    assert reports[-1].note.endswith(f"executed {last.distance:.4g}")


@pytest.mark.slow
@pytest.mark.parametrize("explores", [False, True])
def test_tasks_that_are_tested_before_their_execution_are_no_executions(explores: bool) -> None:
    campaign = Campaign(make_validation(), search=searches.GPUCB() if explores else None, seed=1)
    reports = [report for report in reports_of(lambda: campaign.run(3, None if explores else 1e3)) if report.note]
    assert [(report.done, report.expected) for report in reports] == [(1, 3), (2, 3), (3, 3)]


def test_an_audit_says_how_many_executions_it_needs() -> None:
    campaign = Campaign(make_validation(), search=searches.GPUCB(), seed=1).run(2)
    reports = [report for report in reports_of(lambda: campaign.audit(3)) if report.note]
    assert [(report.done, report.expected) for report in reports] == [(3, 5), (4, 5), (5, 5)]


@pytest.mark.slow
def test_choosing_counts_designs_towards_what_is_expected() -> None:
    campaign = Campaign(make_validation(), search=searches.Auto(100), seed=1).run(2, explore=True)
    reports = reports_of(lambda: campaign.ask())
    designs = [report for report in reports if report.stage == "choosing a task"]
    assert designs[0].done == 0
    assert [report.done for report in designs] == sorted(report.done for report in designs)
    assert 40 <= designs[-1].done <= 220  # a choice that leaves its region needs two ascents
    expected = {report.expected for report in designs} - {None}
    usual = usual_effort(1, 100)
    assert expected == {usual.exact + usual.rough}
    assert last_of(reports)["predicting the execution"].done > 0


@pytest.mark.slow
def test_certifying_reports_what_takes_long() -> None:
    campaign = random_campaign().run(5)
    stages = last_of(reports_of(lambda: campaign.verdict(9.0)))
    assert {"certifying", "searching the learned dynamics"} <= set(stages)
    posterior = CertificateOptions(DistanceBound())
    assert len(last_of(reports_of(lambda: campaign.verdict(9.0, certificate=posterior)))) > 1
    loops = stages["searching the learned dynamics"]
    assert loops.done > 500
    assert loops.ended


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "expected"),
    [
        (partial(grid_truth, per_axis=50, refinements=1), 50 + 8 * 9),
        (partial(search_truth, repeats=2, generations=2, climbs=1, population=8), None),
    ],
)
def test_a_truth_counts_its_executions(truth: Callable[[Validation], object], expected: int | None) -> None:
    last = last_of(reports_of(lambda: truth(make_validation())))["searching the largest distance"]
    assert last.done >= 50
    assert last.expected == expected


def test_measuring_again_counts_trials() -> None:
    campaign = random_campaign().run(3)
    last = last_of(reports_of(campaign.remeasure))["measuring again"]
    assert (last.done, last.expected) == (3, 3)


def test_waiting_for_another_process_is_reported(tmp_path: Path) -> None:
    first, second = (random_campaign(store=tmp_path / "a.sqlite") for _ in range(2))

    def wait() -> None:
        with refuses(StoreAccessError, "a.sqlite"):
            second.ask(wait=0.1)

    with first.store.sole_writer():
        last = last_of(reports_of(wait))["waiting for another process that is running the store"]
    assert 0.04 <= last.done <= 0.12
    assert "waiting for another process that is running the store" not in last_of(
        reports_of(lambda: second.ask(wait=0.1))
    )


def test_a_program_is_told_nothing_unless_it_asks(capfd: Any) -> None:
    random_campaign().run(2)
    assert capfd.readouterr() == ("", "")
    random_campaign().run(2, progress=True)
    shown = capfd.readouterr()
    assert shown.out == ""
    assert [line.split()[:2] for line in shown.err.splitlines()] == [["trial", "0"], ["trial", "1"]]


def test_progress_that_is_not_wanted_is_not_heard_elsewhere() -> None:
    assert not reports_of(lambda: random_campaign().run(2, progress=False))
