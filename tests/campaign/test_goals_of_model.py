from __future__ import annotations

import warnings

import pytest

from conftest import make_validation
from ctxval import Campaign, Labels, Task, Validation, controllers
from ctxval.campaign.goals_of_model import GoalsOfModel, GoalWarning
from ctxval.searches import Random
from facts import assert_names

# The pendulum needs more than half a second for its goals, and reaches them in two.
SHORT, LONG = 25, 150


def long_enough() -> Validation:
    # The weights of the pendulum's own case, with which M swings to every goal.
    synthesizer = controllers.ILQR([1.0, 0.1], [1e-4], [10.0, 1.0])
    return make_validation(horizon=LONG).with_parts(synthesizer=synthesizer)


def without_goal() -> Validation:
    def task(p: object) -> Task:
        return Task([3.1, 0.0], horizon=SHORT, dt=0.02)

    return make_validation(horizon=SHORT).with_parts(task=task)


def test_a_campaign_warns_once_that_the_model_misses_its_goals() -> None:
    validation = make_validation(horizon=SHORT).with_parts(labels=Labels(("angle [rad]", "rate [rad/s]"), ("torque",)))
    campaign = Campaign(validation, search=Random(), seed=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        campaign.run(2)
        assert not caught  # the range of the states is not known yet
        campaign.run(8)
    said = [str(one.message) for one in caught if issubclass(one.category, GoalWarning)]
    assert len(said) == 1
    assert_names(said[0], 3, 10)
    assert_names(said[0], "goal")
    assert_names(said[0], "--aspect1")


@pytest.mark.parametrize("make", [long_enough, without_goal])
def test_a_campaign_is_silent_if_the_model_reaches_its_goals_or_has_none(make: object) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Campaign(make(), search=Random(), seed=0).run(5)  # type: ignore[operator]


def test_nothing_is_planned_for_the_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    validation, designed = make_validation(horizon=SHORT), []

    class Counting(controllers.LQR):
        def design(self, task: Task, model: object) -> controllers.AffineFeedback:
            designed.append(task)
            return super().design(task, model)  # type: ignore[arg-type]

    counted = validation.with_parts(synthesizer=Counting([1.0, 0.1], [1e-2], [10.0, 1.0]))
    with pytest.warns(GoalWarning):
        Campaign(counted, search=Random(), seed=0).run(5)
    watched = len(designed)
    designed.clear()
    monkeypatch.setattr(GoalsOfModel, "watch", lambda self, plan: None)
    Campaign(counted, search=Random(), seed=0).run(5)
    assert len(designed) == watched
