"""Reports of people on trials, for every skin over a campaign."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Experiment, Store, Validation, searches
from ctxval.campaign.telling import ToldResult, parameters_of_trial, require_tolerance, result_sentence, tell_result
from ctxval.core.trial import Trial
from ctxval.errors import InputError


@pytest.fixture
def campaign(validation: Validation) -> Campaign:
    return Campaign(validation, search=searches.Random())


def test_a_report_of_each_kind_is_stored(campaign: Campaign, tmp_path: Path) -> None:
    made = Experiment("pendulum", campaign.validation, units="rad")
    by_file, by_distance, failed = (campaign.ask() for _ in range(3))
    run = campaign.validation.system.execute(by_file.plan.controller, by_file.plan.task)
    run.to_csv(tmp_path / "run.csv")
    told = tell_result(campaign, made, by_file.number, ToldResult(tmp_path / "run.csv"))
    assert told.distance == pytest.approx(campaign.validation.accept(by_file.plan, run).distance)
    assert tell_result(campaign, made, by_distance, ToldResult(distance=0.25)).distance == 0.25
    assert tell_result(campaign, made, failed.number, ToldResult(failed="cut out")).failure == "cut out"
    assert result_sentence(campaign.trials[1], "rad") == "trial 1 has the distance 0.25 rad"
    assert result_sentence(campaign.trials[2]) == "trial 2 failed: cut out"


def test_a_failure_needs_no_controller(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    opened = Campaign(make_validation(), search=searches.Random(), store=store).ask()
    campaign = Campaign(make_validation(), store=store)

    def refuse(*_: object) -> None:
        raise AssertionError("a controller was designed")

    campaign.validation.synthesizer.design = refuse  # type: ignore[method-assign]
    made = Experiment("pendulum", campaign.validation)
    assert tell_result(campaign, made, opened.number, ToldResult(failed="cut out")).state == "failed"
    store.close()


def test_an_unmeasured_trial_says_why() -> None:
    trial = Trial(3, "initial", "unmeasured", np.zeros(1), {"goal": 0.0}, executed=True, failure="it is NaN.")
    assert result_sentence(trial) == "trial 3 is stored without a distance: it is NaN."
    assert result_sentence(replace(trial, state="failed")) == "trial 3 failed: it is NaN."


def test_parameters_of_a_trial(campaign: Campaign) -> None:
    asked = campaign.ask({"goal": 1.5})
    assert parameters_of_trial(campaign, asked.number) == {"goal": pytest.approx(1.5)}
    with pytest.raises(InputError, match="there is no trial 7; there are 1, numbered from 0"):
        parameters_of_trial(campaign, 7)


@pytest.mark.parametrize("given", [-1.0, float("nan"), float("inf")])
def test_a_tolerance_must_be_possible(given: float) -> None:
    with pytest.raises(InputError, match="the tolerance must be a finite number >= 0"):
        require_tolerance(given, "the tolerance")
    require_tolerance(None, "the tolerance")


def test_a_campaign_sees_what_another_process_has_stored(tmp_path: Path) -> None:
    one, other = (Campaign(make_validation(), search=searches.Random(), store=tmp_path / "a.sqlite") for _ in range(2))
    one.tell(one.ask(), distance=0.5)
    assert not other.trials
    other.refresh()
    assert [trial.distance for trial in other.trials] == [0.5]
    for campaign in (one, other):
        campaign.store.close()
