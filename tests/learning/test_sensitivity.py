from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.campaign.dynamics import SensitivityWarning
from ctxval.campaign.thinking import CampaignThinking
from ctxval.cli.config.check import _small_changes
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.sensitivity import Sensitivity, found_sensitivity
from ctxval.learning.stage_costs import Speed, Thinking

SPEED = Speed(1.0, 1e-6, 1e-6, 1e-6, 1e-6, True, True, 2, 1, 20)
UNLIMITED = Thinking(np.inf, np.inf, SPEED)


def validation(wall: float) -> Validation:
    """Return a point that is thrown back at a wall, to the one side or the other, or never if it is far away."""

    def step(x: Array, u: Array) -> Array:
        place, rate = x[..., 0], x[..., 1]
        hit = (place > wall) & (rate > 0)
        rate = np.where(hit, -rate * np.where(np.sin(20 * rate) > 0, 1.0, 0.2), rate) + 0.05 * u[..., 0]
        return np.stack([place + 0.1 * rate, rate], axis=-1)

    model = models.Function(step, vectorized=True)
    return Validation(
        space=TaskSpace(rate=(0.5, 1.5)),
        task=lambda p: Task(np.stack([0 * p.rate, p.rate], axis=-1), horizon=20, dt=0.1),
        system=systems.Simulated(model),
        model=model,
        synthesizer=controllers.Policy(lambda t, x, task: -0.1 * x[..., :1], vectorized=True),
        distance=distances.MaximumDeviation(components=[0]),
    )


def test_smooth_loops_are_not_spoken_of_and_those_with_contacts_are() -> None:
    assert found_sensitivity(LoopPlanner(validation(np.inf)), UNLIMITED) is None
    found = found_sensitivity(LoopPlanner(validation(0.5)), UNLIMITED)
    assert found is not None
    assert found.largest > 0.3 * found.larger_change
    assert found.median < 0.2 * found.largest
    assert 0 < found.spikes < 1
    assert found.tasks == 256


def test_changes_that_do_not_matter_to_a_threshold_and_those_without_time_are_not_spoken_of() -> None:
    planner = LoopPlanner(validation(0.5))
    assert found_sensitivity(planner, UNLIMITED, 100.0) is None
    assert found_sensitivity(planner, UNLIMITED, 1.0) is not None
    assert found_sensitivity(planner, replace(UNLIMITED, seconds=1e-6)) is None


@pytest.mark.parametrize("largest", [0.2, np.inf])
def test_a_sensitivity_comes_back_from_json(largest: float) -> None:
    found = Sensitivity(largest, 0.01, 0.3, 0.05, 256)
    assert Sensitivity.from_json(found.to_json()) == found
    assert Sensitivity.from_json({"largest": 1.0}) is None
    assert Sensitivity.from_json({**found.to_json(), "median": "much"}) is None
    assert "0.99" in found.in_words("m")


def test_a_campaign_says_it_before_its_first_execution_and_stores_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CampaignThinking, "after", lambda self, trials: None if trials else UNLIMITED)
    campaign = Campaign(validation(0.5))
    with pytest.warns(SensitivityWarning):
        campaign.run(1, 1.0)
    assert campaign.sensitivity == found_sensitivity(LoopPlanner(validation(0.5)), UNLIMITED, 1.0)
    campaign.run(2, 1.0)
    assert [trial.note.sensitivity is not None for trial in campaign.trials] == [True, False]
    assert Campaign(validation(0.5)).run(1, 1.0, share=0.99).sensitivity is None  # it asks for a stable number already
    assert Campaign(validation(np.inf)).run(1, 1.0).sensitivity is None


def test_a_check_says_it() -> None:
    assert [state for state, _ in _small_changes(validation(0.5))] == ["noted"]
    assert list(_small_changes(validation(np.inf))) == []
