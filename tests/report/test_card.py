"""The card of a campaign."""

from __future__ import annotations

import json
from typing import Any

import pytest

from ctxval import Campaign, Task, TaskSuite, Validation, controllers, distances, models, report, systems


@pytest.fixture
def campaign() -> Campaign:
    """Return three tasks, all executed: the distances grow with the goal."""

    def task(p: Any) -> Task:
        return Task([0.0], goal=[p.goal], horizon=5, dt=0.1)

    validation = Validation(
        space=TaskSuite({"near": {"goal": 0.5}, "far": {"goal": 2.0}, "back | there": {"goal": -1.0}}),
        task=task,
        system=systems.Simulated(models.Linear([[0.9]], [[0.1]])),
        model=models.Linear([[1.0]], [[0.1]]),
        synthesizer=controllers.LQR([1.0], [0.1]),
        distance=distances.MaximumDeviation(),
    )
    return Campaign(validation, name="cart")


def test_a_card_has_the_verdicts_at_all_stated_thresholds(campaign: Campaign) -> None:
    campaign.run(3, 10.0)
    assert campaign.worst is not None
    largest = campaign.worst.distance or 0.0
    verdict = campaign.verdict(0.9 * largest)
    card = report.card(report.context_of_campaign(campaign, verdict), "our own, CC0")
    assert card.least == card.most == largest
    assert [(each.threshold, each.answer) for each in card.verdicts] == [
        (0.9 * largest, "falsified"),
        (10.0, "validated"),
    ]
    executed = [trial.distance for trial in campaign.trials]
    assert card.verdicts[0].executions == 1 + executed.index(largest)
    assert card.verdicts[1].executions == card.executions == 3
    known = json.loads(json.dumps(card.to_json()))
    assert known["origin"] == "our own, CC0"
    assert known["model"] == "Linear"


def test_a_card_without_executions_says_so(campaign: Campaign) -> None:
    card = report.card(report.context_of_campaign(campaign))
    assert (card.least, card.most, card.verdicts, card.worst) == (None, None, (), "")
    assert len(card.row()) == len(card.HEAD)


def test_names_cannot_become_markup(campaign: Campaign) -> None:
    campaign.run(3, 10.0)
    card = report.card(report.context_of_campaign(campaign), "<b>|`")
    row = card.markdown().splitlines()[2]
    assert row.replace("\\|", "").count("|") == len(card.HEAD) + 1
    assert "\\<b\\>\\|\\`" in row
