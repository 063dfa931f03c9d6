"""Tasks that are being executed: they count as predicted, and the choice of the next task is a function of all this."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from ctxval import Campaign, Validation, cases, searches
from ctxval.campaign.choices import Choice, Execution
from ctxval.campaign.dynamics import NEAR
from ctxval.campaign.execution import ExecutionLoop
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.campaign.workers import WorkerPool, execute_task
from ctxval.certificates import CertificateOptions
from ctxval.core.plan import Plan
from rig_thorough import more


@dataclass
class Pool(WorkerPool):
    """Workers in this process, whose executions end in a seeded order."""

    validation: Validation
    size: int
    seed: int = 0
    running: list[tuple[int, Plan]] = field(default_factory=list)
    together: list[list[int]] = field(default_factory=list)

    def start(self, number: int, plan: Plan) -> None:
        self.running.append((number, plan))

    def wait(self) -> list[tuple[int, Execution]]:
        self.together.append([number for number, _ in self.running])
        row = np.random.default_rng([self.seed, len(self.together)]).integers(len(self.running))
        number, plan = self.running.pop(row)
        return [(number, execute_task(self.validation.system, plan.controller, plan.task))]

    def close(self) -> None:
        self.running.clear()


def linear(dim: int = 2, seed: int = 0) -> Validation:
    return cases.by_name("linear", seed, dim=dim).validation


def run(campaign: Campaign, pool: Pool, budget: int, rule: Callable[[], Choice | None] = Choice) -> Campaign:
    ExecutionLoop(campaign.recorder, rule, pool, budget=budget).run()
    return campaign


def points(campaign: Campaign) -> np.ndarray:
    return np.array([trial.unit_point for trial in campaign.trials])


def test_one_worker_makes_the_choices_of_none() -> None:
    alone = Campaign(linear(), search=searches.Auto("fast"), seed=3).run(5, explore=True)
    validation = linear()
    of_pool = run(Campaign(validation, search=searches.Auto("fast"), seed=3), Pool(validation, 1), 5)
    np.testing.assert_array_equal(points(of_pool), points(alone))


@pytest.mark.parametrize("dim", [1, 5])
def test_the_first_tasks_of_eight_workers_are_far_apart(dim: int) -> None:
    validation = linear(dim)
    found = points(run(Campaign(validation, search=searches.Auto("fast")), Pool(validation, 8), 8))
    gaps = np.linalg.norm(found[:, None] - found, axis=2)[~np.eye(8, dtype=bool)]
    random = np.random.default_rng(0).random((50, 8, 2 * dim))
    of_random = np.linalg.norm(random[:, :, None] - random[:, None], axis=3) + 9 * np.eye(8)
    assert gaps.min() > 2 * np.median(of_random.min(axis=(1, 2)))
    assert np.isin(found[1:], [0.0, 1.0]).mean() > 0.5
    first = Campaign(linear(dim), search=searches.Auto("fast")).run(1, explore=True)
    np.testing.assert_array_equal(found[0], points(first)[0])


def test_without_trajectories_in_mind_the_search_chooses_the_first_tasks_itself() -> None:
    validation = linear()
    found = points(run(Campaign(validation, search=searches.Random(), seed=2), Pool(validation, 4), 4))
    np.testing.assert_array_equal(found, points(Campaign(linear(), search=searches.Random(), seed=2).run(4)))


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_workers_never_run_the_same_task_at_the_same_time(seed: int) -> None:
    validation = linear(2, seed)
    pool = Pool(validation, 4, seed)
    found = points(run(Campaign(validation, search=searches.Auto("fast"), seed=seed), pool, 9))
    for together in pool.together:
        gaps = np.abs(found[together][:, None] - found[together]).max(axis=2) + np.eye(len(together))
        assert gaps.min() > NEAR


@pytest.mark.thorough
def test_spare_workers_that_decide_execute_different_tasks() -> None:
    validation = linear(2)
    pool, campaign = Pool(validation, 4), Campaign(validation, search=searches.Auto("fast"))
    decides = IntervalSearch(campaign.recorder, CertificateOptions.or_automatic(None, 0.95, 0.1), 8)
    with campaign.recorder.predicting(decides.predicts):
        found = points(run(campaign, pool, 8, decides.choose))
    for together in pool.together:
        gaps = np.abs(found[together][:, None] - found[together]).max(axis=2) + np.eye(len(together))
        assert gaps.min() > NEAR
    # What a verdict says rests on executions alone.
    assert all(trial.distance is not None for trial in campaign.trials)


@pytest.mark.parametrize("seed", [1, *more(0, 2)])
def test_a_choice_is_a_function_of_the_history(tmp_path: Path, seed: int) -> None:
    path, rng = tmp_path / "a.sqlite", np.random.default_rng(seed)
    validation = linear(1, seed)
    campaign = Campaign(validation, search=searches.Auto("fast"), seed=seed, store=path)
    waiting = []
    for step in range(5):
        copy = tmp_path / f"{step}.sqlite"
        shutil.copyfile(path, copy)
        again = Campaign(linear(1, seed), search=searches.Auto("fast"), seed=seed, store=copy).ask()
        waiting.append(campaign.ask())
        np.testing.assert_array_equal(again.trial.unit_point, waiting[-1].trial.unit_point)
        while len(waiting) > 2:
            opened = waiting.pop(rng.integers(len(waiting)))
            campaign.tell(opened, validation.execute(opened.plan))


def test_what_is_being_executed_counts_as_predicted() -> None:
    validation = linear(3)
    campaign = Campaign(validation, search=searches.Auto("fast")).run(2, explore=True)
    opened = campaign.ask({"x_init": [1.0, -1.0, 1.0], "x_final": [-1.0, -1.0, 1.0]})
    dynamics, place = campaign.recorder.dynamics, opened.trial.unit_point[None]
    prediction = dynamics.prediction(campaign.trials, pending=True)
    assert prediction is not None
    assert prediction.pending is not None
    np.testing.assert_array_equal(prediction.pending.points, place)
    after = prediction.pending.prediction()
    (value, doubt), (expected, less) = prediction.expected(place), after.expected(place)
    assert expected == pytest.approx(value, rel=0.02)
    assert less < 0.5 * doubt
    alone = dynamics.prediction(campaign.trials)
    assert alone is not None
    assert alone.pending is None
