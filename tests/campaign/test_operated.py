"""Campaigns that people operate until they are decided: the same tasks as a campaign that runs by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, cases, searches
from ctxval.certificates import AnytimeAudit, Audit, Automatic, CertificateOptions
from ctxval.errors import InputError
from facts import refuses


def facts(campaign: Campaign) -> list[tuple[object, ...]]:
    return [(t.state, t.unit_point.tobytes(), t.distance) for t in campaign.trials]


def operate(campaign: Campaign, threshold: float, budget: int, **options: object) -> Campaign:
    """Do what operators do: ask, execute, tell, until nothing is asked any more."""
    validation = campaign.validation
    while (opened := campaign.ask_for_verdict(threshold, budget, **options)) is not None:  # type: ignore[arg-type]
        executed = validation.system.execute(opened.plan.controller, opened.plan.task)
        campaign.tell(opened, executed)
    return campaign


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.9, 1.1])
@pytest.mark.thorough
def test_people_execute_the_same_tasks_as_a_campaign_that_runs_by_itself(share: float, tmp_path: Path) -> None:
    case = cases.by_name("linear", 0, dim=1)
    assert case.truth is not None
    threshold = share * case.truth().distance
    by_itself = Campaign(case.validation).run(20, threshold)
    by_people = operate(Campaign(case.validation, store=tmp_path / "people.sqlite"), threshold, 20)
    assert facts(by_people) == facts(by_itself)
    answers = {campaign.verdict(threshold).answer for campaign in (by_people, by_itself)}
    assert answers == {"falsified" if share < 1 else "validated"}


@pytest.mark.slow
@pytest.mark.thorough
def test_each_task_is_predicted_beforehand_and_a_reopened_store_goes_on(tmp_path: Path) -> None:
    case = cases.by_name("linear", 1, dim=1)
    assert case.truth is not None
    threshold, path = 1.1 * case.truth().distance, tmp_path / "people.sqlite"
    options = CertificateOptions(Automatic(tests=2))
    for _ in range(20):
        # A new process for each task, as people have it.
        campaign = Campaign(case.validation, store=path)
        opened = campaign.ask_for_verdict(threshold, 20, certificate=options)
        if opened is None:
            break
        campaign.tell(opened, case.validation.system.execute(opened.plan.controller, opened.plan.task))
        campaign.store.close()
    assert campaign.verdict(threshold, certificate=options).answer == "validated"
    assert all(trial.note.search is not None for trial in campaign.trials)
    assert facts(campaign) == facts(Campaign(case.validation).run(20, threshold, certificate=options))


def test_the_budget_counts_open_trials() -> None:
    campaign = Campaign(make_validation(), search=searches.GPUCB())
    assert campaign.ask_for_verdict(1e-9, 2) is not None
    assert campaign.ask_for_verdict(1e-9, 2) is not None
    assert campaign.ask_for_verdict(1e-9, 2) is None
    assert len(campaign.trials) == 2


def test_a_counterexample_ends_the_questions() -> None:
    campaign = Campaign(make_validation(), search=searches.GPUCB())
    opened = campaign.ask_for_verdict(0.1, 9)
    assert opened is not None
    campaign.tell(opened, distance=0.2)
    assert campaign.ask_for_verdict(0.1, 9) is None


def test_draws_of_an_anytime_audit_are_asked_for_until_its_volume_suffices() -> None:
    campaign = Campaign(make_validation(), search=searches.GPUCB())
    options = CertificateOptions(AnytimeAudit(), volume=0.5)
    for _ in range(30):
        opened = campaign.ask_for_verdict(1.0, 30, certificate=options)
        if opened is None:
            break
        assert opened.trial.origin == "iid"
        campaign.tell(opened, distance=0.5)
    assert 2 < len(campaign.trials) < 30


@pytest.mark.parametrize("budget", [0, -1, 1.5, "3"])
def test_a_budget_that_is_no_positive_integer_is_refused(budget: object) -> None:
    with refuses(InputError, "budget"):
        Campaign(make_validation()).ask_for_verdict(1.0, budget)  # type: ignore[arg-type]


def test_what_cannot_decide_is_refused_and_opens_nothing() -> None:
    campaign = Campaign(make_validation(), search=searches.GPUCB())
    with refuses(InputError, "decides", "audit"):
        campaign.ask_for_verdict(1.0, 5, certificate=CertificateOptions(Audit()))
    with refuses(InputError, "threshold"):
        campaign.ask_for_verdict(np.nan, 5)
    assert not campaign.trials
