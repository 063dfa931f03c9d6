from __future__ import annotations

import time

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Experiment, Task, Validation, controllers, distances, searches
from ctxval.campaign.choices import Choice
from ctxval.campaign.costs import ThinkingCosts
from ctxval.cli.config.check import check_experiment
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from ctxval.gp.ascent import usual_effort
from facts import assert_names
from faulty_rig import FaultyRig

pytestmark = pytest.mark.in_full

BURNT = 0.01


class Busy:
    """A synthesizer that needs the processor."""

    def __init__(self, seconds: float = BURNT) -> None:
        self.seconds = seconds

    def design(self, task: Task, model: Model) -> Controller:
        until = time.process_time() + self.seconds
        while time.process_time() < until:
            pass
        return controllers.LQR([1.0, 0.1], [1e-2], [10.0, 1.0]).design(task, model)


def with_synthesizer(synthesizer: object) -> Validation:
    whole = make_validation(system=FaultyRig(make_validation().system, dict.fromkeys(range(100), "raise")))
    return Validation(
        space=whole.space,
        task=whole.task,
        system=whole.system,
        model=whole.model,
        synthesizer=synthesizer,
        distance=whole.distance,
    )


def costs(validation: Validation) -> ThinkingCosts:
    return ThinkingCosts.measured(validation, [np.array([goal]) for goal in (-3.0, 0.5, 3.0)])


@pytest.mark.thorough
def test_a_suggestion_costs_at_least_its_designs() -> None:
    found = costs(with_synthesizer(Busy()))
    assert found.designs == 150
    assert found.suggestion is not None
    assert found.fast is not None
    assert found.design >= BURNT > found.closed_loop
    usual = [usual_effort(1, budget).exact for budget in (150, 22)]  # in one dimension, none is rough
    assert found.suggestion >= usual[0] * BURNT
    assert found.choice is not None
    assert found.verdict is not None
    assert 64 * BURNT <= found.choice < found.verdict  # the pool of designs that are made one at a time
    assert usual[1] * BURNT <= found.fast < found.suggestion


@pytest.mark.thorough
def test_the_estimate_is_that_of_a_real_suggestion_within_a_factor() -> None:
    validation = make_validation()
    campaign = Campaign(validation, search=searches.Auto("thorough"), seed=1).run(3, explore=True)
    started = time.process_time()
    campaign.recorder._proposals.next(campaign.trials, Choice())
    real = time.process_time() - started
    estimated = costs(validation).suggestion
    assert estimated is not None
    assert real / 10 < estimated < 10 * real


@pytest.mark.slow
@pytest.mark.thorough
def test_a_check_states_the_costs_without_an_execution() -> None:
    found = {one.check: one for one in check_experiment(Experiment("x", with_synthesizer(Busy(0.0))))}
    assert found["cost"].state == "ok"
    seconds = r"[\d.e-]+ s"
    assert_names(found["cost"].text, "CPU", "--explore", seconds)


def test_a_suggestion_that_cannot_be_predicted_has_no_estimate() -> None:
    class Refusing(Busy):
        def design(self, task: Task, model: Model) -> Controller:
            if abs(float(task.goal[0])) != 3.0:
                raise ValueError
            return controllers.LQR([1.0, 0.1], [1e-2], [10.0, 1.0]).design(task, model)

    validation = with_synthesizer(Refusing()).with_parts(distance=distances.WholeTrajectory())
    found = ThinkingCosts.measured(validation, [np.array([3.0]), np.array([-3.0])])
    assert found.suggestion is None
    assert found.design < 1.0
