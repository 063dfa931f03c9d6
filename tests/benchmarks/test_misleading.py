"""Systems built to mislead the residual: the search falls back, says so, and still beats random."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ctxval import Campaign, Task, searches
from ctxval._util.arrays import Array
from ctxval.testing import check_system

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import misleading  # noqa: E402


class Thrifty(searches.Auto):
    """The search with a tenth of its computing time, enough to show whether it is misled."""

    def use_prediction(self, prediction: searches.Prediction | None) -> None:
        super().use_prediction(None if prediction is None else replace(prediction, budget=200))


@pytest.mark.parametrize("case", misleading.CASES)
def test_the_systems_conform_and_their_tasks_can_be_planned(case: str) -> None:
    validation = misleading.CASES[case](0).validation
    plan = validation.plan(validation.space.from_unit(np.full(validation.space.dimension, 0.5)))
    check_system(validation.system, plan.controller, plan.task)


@pytest.mark.parametrize("case", ["hidden-heat", "hidden-load"])
def test_one_state_and_input_lead_to_two_next_states_where_a_state_is_hidden(case: str) -> None:
    system = misleading.CASES[case](0).validation.system
    whole = system.execute(lambda t, x: np.array([2.0]), Task([1.0, 0.0], horizon=20, dt=misleading.DT)).states
    # From the state that it passed through, under the same input, but with nothing before it.
    anew = system.execute(lambda t, x: np.array([2.0]), Task(whole[-2], horizon=1, dt=misleading.DT)).states
    assert np.abs(anew[1] - whole[-1]).max() > 1e-3


def test_few_tasks_meet_the_stop() -> None:
    validation = misleading.corner_stop(0).validation
    task = validation.task(validation.space.parameters(validation.space.iid(1000, np.random.default_rng(0))))
    executed = validation.system.execute(validation.synthesizer.design(task, validation.model), task)
    met = (executed.states[..., 0] > misleading.CartWithStop().stop).any(axis=-1)
    assert 0 < met.mean() < 0.03


def best_of_random(case: str, budget: int) -> Array:
    """Return the largest of so many random executions, 100 times."""
    validation = misleading.CASES[case](0).validation
    points = validation.space.iid(100 * budget, np.random.default_rng(0))
    return validation.distances(points).reshape(100, budget).max(axis=1)


@pytest.mark.slow
@pytest.mark.in_full
@pytest.mark.parametrize(
    ("case", "budget"), [pytest.param("hidden-load", 14, marks=pytest.mark.thorough), ("corner-stop", 12)]
)
@pytest.mark.thorough
def test_the_search_falls_back_says_why_and_beats_random(case: str, budget: int) -> None:
    campaign = Campaign(misleading.CASES[case](0).validation, search=Thrifty(), seed=0)
    campaign.run(budget, explore=True)
    assert campaign.worst is not None
    assert campaign.worst.distance is not None
    assert campaign.worst.distance > np.median(best_of_random(case, budget))
