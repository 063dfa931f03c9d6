"""How long `auto` thinks, on systems whose executions are cheap and dear."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, distances, searches, systems
from ctxval.campaign.costs import costs_of
from ctxval.core.controller import Controller
from ctxval.systems import Manual


class Slowed:
    """A system or a synthesizer that takes its time."""

    def __init__(self, inner: Any, seconds: float) -> None:
        self.inner, self.seconds = inner, seconds

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        time.sleep(self.seconds)
        found: Trajectory = self.inner.execute(controller, task)
        return found

    def design(self, task: Task, model: object) -> Controller:
        until = time.process_time() + self.seconds
        while time.process_time() < until:
            pass
        found: Controller = self.inner.design(task, model)
        return found


def validation(design: float, execution: float) -> Validation:
    whole = make_validation()
    whole.model.data = None  # type: ignore[attr-defined]
    return replace_parts(whole, Slowed(whole.system, execution), Slowed(whole.synthesizer, design))


def replace_parts(whole: Validation, system: Any, synthesizer: Any) -> Validation:
    return Validation(
        space=whole.space,
        task=whole.task,
        system=system,
        model=whole.model,
        synthesizer=synthesizer,
        distance=whole.distance,
    )


def designs_of(campaign: Campaign) -> list[int]:
    return [trial.note.search["designs"] for trial in campaign.trials if "designs" in (trial.note.search or {})]


@pytest.mark.slow
@pytest.mark.in_full
@pytest.mark.thorough
def test_dear_executions_are_thought_about_longer_than_cheap_ones() -> None:
    # A design takes 20 ms. So 22 of them take less than 1 s, and 60 take longer, but far less than 6 s on any machine.
    campaigns = [Campaign(validation(0.02, seconds), seed=1).run(1) for seconds in (0.0, 6.0)]
    for campaign in campaigns:
        campaign.ask()
    cheap, dear = (designs_of(campaign) for campaign in campaigns)
    assert cheap == [22]
    assert dear[0] >= 60


@pytest.mark.slow
@pytest.mark.in_full
def test_a_campaign_keeps_its_number_of_designs_when_it_is_resumed(tmp_path: Path) -> None:
    def campaign(design: float, reason: str | None = None) -> Campaign:
        return Campaign(validation(design, 0.0), seed=1, store=tmp_path / "a.sqlite", accept_change=reason)

    campaign(0.02).run(2, explore=True).store.close()
    assert designs_of(campaign(0.0, "the same design, computed faster").run(4, explore=True)) == [22]


@pytest.mark.slow
def test_the_costs_are_those_of_a_design_and_an_execution() -> None:
    found = []
    for design, execution in ((0.0, 0.02), (0.02, 0.0)):
        campaign = Campaign(validation(design, execution), search=searches.Random(), seed=1).run(2)
        found.append(measured(campaign))
    (cheap, slow_execution), (slow_design, _) = found
    assert slow_execution is not None
    assert cheap < 0.02 <= slow_execution
    assert slow_design >= 0.02


def measured(campaign: Campaign) -> tuple[float, float | None]:
    prediction = campaign.recorder.dynamics.prediction(campaign.trials)
    assert prediction is not None
    costs = costs_of(prediction, campaign.validation, campaign.trials)
    return costs.prediction, costs.evaluation


def test_people_cost_more_than_all_thinking_and_untimed_executions_cost_nothing_known() -> None:
    whole = make_validation()
    by_hand = replace_parts(
        whole, Manual(states={"angle": "rad", "speed": "rad/s"}, inputs={"torque": "N m"}, dt=0.02), whole.synthesizer
    )
    for parts, expected in ((by_hand, math.inf), (whole, None)):
        campaign = Campaign(parts, search=searches.Random(), seed=1)
        opened = campaign.ask()
        campaign.tell(opened, whole.execute(opened.plan))
        assert measured(campaign)[1] == expected


@pytest.mark.slow
@pytest.mark.thorough
def test_a_number_of_designs_makes_the_same_choices_each_time() -> None:
    campaigns = [Campaign(make_validation(), search=searches.Auto(60), seed=4).run(3, explore=True) for _ in range(2)]
    points = [[trial.unit_point for trial in campaign.trials] for campaign in campaigns]
    np.testing.assert_array_equal(*points)


class Constant:
    def design(self, task: Task, model: object) -> Controller:
        return lambda t, x: np.asarray(task.goal)


def test_a_model_may_refuse_states_that_its_closed_loops_do_not_visit(tmp_path: Path) -> None:
    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        if np.abs(x).max() > 1.2:
            raise ValueError("out of table")
        return np.array([0.9 * x[0] + 0.1 * u[0]])

    validation = Validation(
        space=TaskSpace(goal=(-1.0, 1.0)),
        task=lambda p: Task(initial_state=[0.0], goal=[p.goal], horizon=8, dt=0.1),
        system=systems.Simulated(lambda x, u: 0.85 * x + 0.1 * u),
        model=step,
        synthesizer=Constant(),
        distance=distances.FinalState(),
    )
    assert Campaign(validation, store=tmp_path / "a.sqlite").run(2).executions == 2
