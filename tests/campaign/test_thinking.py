"""Campaigns with a budget of thinking: what is replaced, what a trial stores of it, and what a verdict says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Trial
from ctxval.campaign.thinking import CampaignThinking
from ctxval.certificates import CertificateOptions
from ctxval.errors import CertificateError, InputError
from ctxval.learning import DynamicsStudy
from ctxval.learning.stage_costs import Ledger, Speed
from ctxval.studies.causes import find_causes
from facts import assert_names, refuses

SPEED = Speed(1.0, 1e-4, 1e-5, 1e-4, 1e-5, True, True, 2, 1, 25)
SLOW = replace(SPEED, design=0.1, another_design=0.1, step=0.05, another_step=0.05, together=False, batched=False)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[Speed]:
    """The speed that is measured, which a test may change; stages take as long as expected."""
    speeds = [SPEED]
    monkeypatch.setattr(Speed, "measured", classmethod(lambda *_: speeds[0]))
    monkeypatch.setattr(Ledger, "_switch", lambda self: self.spent.update(self.expected))
    return speeds


def thoughts(campaign: Campaign) -> list[dict[str, Any]]:
    return [trial.note.thinking or {} for trial in campaign.trials]


def facts(trials: tuple[Trial, ...]) -> list[tuple[Any, ...]]:
    notes = [replace(t.note, thinking=None) for t in trials]
    return [(t.unit_point.tobytes(), t.origin, t.distance, str(note)) for t, note in zip(trials, notes, strict=True)]


def test_a_budget_that_suffices_changes_nothing(measured: list[Speed]) -> None:
    limited, free = (Campaign(make_validation(), seed=0).run(6, 0.5, thinking=each) for each in (1e4, np.inf))
    assert facts(limited.trials) == facts(free.trials)
    assert not any(thought.get("replaced") for thought in thoughts(limited))
    assert not any(thoughts(free))
    verdicts = [each.verdict(0.5, thinking=1e4).to_json() for each in (limited, free)]
    assert verdicts[0] == verdicts[1]


def test_without_time_for_closed_loops_distances_choose(measured: list[Speed]) -> None:
    measured[0] = SLOW
    campaign = Campaign(make_validation(), seed=0).run(4, 100.0, thinking=1.0)
    assert all(trial.note.prediction is None for trial in campaign.trials)
    assert thoughts(campaign)[1]["replaced"] == ["learned dynamics, by the distances alone"]
    verdict = campaign.verdict(100.0, thinking=1.0)
    assert verdict.answer == "undecided"
    assert verdict.shortage is not None
    assert (verdict.shortage["code"], verdict.shortage["budget"]) == ("no_time", 1.0)
    assert verdict.shortage["suggested"] > verdict.shortage["needed"] > 1.0
    assert verdict.to_json()["thinking"] == verdict.shortage


def test_evidence_that_does_not_fit_decides_nothing_until_there_is_time(measured: list[Speed]) -> None:
    threshold = 5.0
    campaign = Campaign(make_validation(), seed=0).run(16, threshold)
    free = campaign.verdict(threshold)
    campaign = Campaign(make_validation(), seed=0).run(16, threshold, thinking=0.5)
    short = campaign.verdict(threshold, thinking=0.5)
    assert free.answer == "validated"
    assert short.answer == "undecided"
    assert short.shortage is not None
    executions = campaign.executions
    # The time that it asks for suffices, and costs no execution unless tests are missing.
    again = campaign.verdict(threshold, thinking=50 * short.shortage["suggested"])
    assert again.shortage is None
    assert campaign.executions == executions


def test_certificates_keep_the_budget_and_name_the_time_that_they_need(measured: list[Speed]) -> None:
    measured[0] = SLOW
    campaign = Campaign(make_validation(), seed=0).run(4, 100.0, thinking=1.0)
    with refuses(CertificateError, "--thinking"):
        campaign.certify(thinking=1.0)
    with refuses(CertificateError, "--thinking"):
        campaign.assessed(100.0, CertificateOptions(), 1.0)
    falsified = campaign.assessed(1e-6, CertificateOptions(), 1.0)
    assert falsified.certificate is None
    assert_names(falsified.refusal, "--thinking")
    assert falsified.verdict is not None
    assert falsified.verdict.answer == "falsified"


@pytest.mark.slow
def test_envelopes_of_a_budget_run_fewer_closed_loops_or_name_the_time_that_they_need(measured: list[Speed]) -> None:
    tau = 0.5
    campaign = Campaign(make_validation(), seed=0).run(14, tau, envelope=True)
    free, large = (campaign.envelope(tau, thinking=each) for each in (np.inf, 1e4))
    assert free.thinking is None
    assert large.to_json() == free.to_json()
    assert free.evaluated > 64
    found = [campaign.envelope(tau, thinking=seconds) for seconds in (0.3, 1.2, 3.0, 8.0)]
    short = [each for each in found if each.doubt is not None]
    fewer = [each for each in found if each.doubt is None and each.thinking is not None]
    assert fewer
    assert all(each.evaluated < free.evaluated for each in fewer)
    assert all(each.thinking is not None and each.thinking["replaced"] for each in fewer)
    assert [(each.thinking or {})["code"] for each in short] == ["no_time"] * len(short)
    assert short
    # What fewer loops trust is trusted.
    tasks = campaign.validation.space.iid(200, np.random.default_rng(3))
    true = campaign.validation.distances(tasks)
    assert (true[fewer[0].trusted(tasks)] <= tau).all()


@pytest.mark.slow
def test_a_search_for_causes_reads_less_or_names_the_time_that_it_needs(measured: list[Speed]) -> None:
    measured[0] = replace(SPEED, step=2e-3)
    campaign = Campaign(make_validation(), seed=0).run(5)
    free = find_causes(campaign, most=1, thinking=np.inf)
    fewer = find_causes(campaign, most=1, thinking=5.0)
    assert free.replaced == ()
    assert (fewer.replaced != (), fewer.executions < free.executions) == (True, True)
    assert fewer.to_json()["thinking"] == {"replaced": list(fewer.replaced)}
    with refuses(InputError, "--thinking"):
        find_causes(campaign, thinking=1e-2)


def test_a_resumed_campaign_makes_the_same_choices(measured: list[Speed], tmp_path: Path) -> None:
    whole = Campaign(make_validation(), seed=0).run(6, 5.0, thinking=0.15)
    store = tmp_path / "parts.sqlite"
    for budget in (2, 4, 6):
        measured[0] = SPEED if budget == 2 else SLOW  # another machine: the stored speed counts
        parts = Campaign(make_validation(), seed=0, store=store).run(budget, 5.0, thinking=0.15)
    assert any(thought.get("replaced") for thought in thoughts(whole))
    assert facts(parts.trials) == facts(whole.trials)
    assert thoughts(parts) == thoughts(whole)


def test_what_only_reads_a_store_without_a_speed_is_not_limited(measured: list[Speed]) -> None:
    campaign = Campaign(make_validation(), seed=0).run(4, 0.5, thinking=np.inf)
    measured[0] = SLOW
    assert campaign.verdict(0.5, thinking=1e-3).shortage is None


def test_the_default_is_that_of_executions(measured: list[Speed]) -> None:
    thinking = CampaignThinking(lambda: DynamicsStudy(make_validation()), False)
    assert thinking.after([]) is None
    with thinking.limited(2.0):
        assert thinking.after([]) is None  # no speed is known yet
        thinking.measure([])
        limit = thinking.after([])
        assert limit is not None
        assert (limit.seconds, limit.decisive, limit.speed) == (2.0, 2.0, SPEED)
        with thinking.deciding():
            assert thinking.after([]) == limit
    with thinking.limited(np.inf):
        assert thinking.after([]) is None


@pytest.mark.parametrize("seconds", [0, -1.0, np.nan, "fast"])
def test_other_budgets_are_refused(seconds: Any) -> None:
    with pytest.raises(InputError, match="thinking"):
        Campaign(make_validation(), seed=0).run(2, 0.5, thinking=seconds)


def test_without_a_budget_whether_there_is_time_is_known_without_trajectories(monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = Campaign(make_validation(), seed=0).run(2)
    monkeypatch.setattr("ctxval.campaign.dynamics.executed_trials", None)
    assert not campaign.recorder.dynamics.has_no_time(campaign.trials)
