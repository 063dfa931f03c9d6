"""Campaigns on suites of tasks, each of which is executed once."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSuite, Trajectory, Validation, systems
from ctxval.certificates import Audit, CertificateOptions, DistanceBound, WholeSuite
from ctxval.core.controller import Controller
from ctxval.errors import CertificateError, InputError
from ctxval.searches import CMAES, GPUCB, BayesianOptimisation, Random
from facts import assert_names, refuses
from rig_suites import COARSE, FINE, step, validation
from rig_thorough import more


def names(campaign: Campaign) -> list[Any]:
    return [trial.parameters["task"] for trial in campaign.trials]


def true_distances(given: Validation) -> np.ndarray:
    return given.distances(given.space.grid(2))


SEARCHES = [None, Random(), CMAES(), GPUCB(), BayesianOptimisation()]


@pytest.mark.parametrize("search", SEARCHES, ids=lambda search: type(search).__name__)
@pytest.mark.parametrize("explore", [True, False])
def test_every_task_is_executed_once_and_then_the_campaign_ends(search: Any, explore: bool) -> None:
    campaign = Campaign(validation(), search=search, seed=1).run(50, 9.0, explore=explore)
    assert Counter(names(campaign)) == Counter(COARSE.task_names)
    verdict, largest = campaign.verdict(9.0), true_distances(campaign.validation).max()
    assert verdict.answer == "validated"
    assert verdict.bound == pytest.approx(largest, rel=1e-12)


def test_random_searches_have_another_order_for_each_seed() -> None:
    orders = [names(Campaign(validation(), search=Random(), seed=seed).run(6)) for seed in range(4)]
    assert len({tuple(order) for order in orders}) > 1


def test_a_smooth_suite_is_validated_before_all_of_it_is_executed() -> None:
    given = validation(FINE, lambda p: p.goal)
    largest = true_distances(given).max()
    campaign = Campaign(given, seed=0).run(41, 1.25 * largest)
    verdict = campaign.verdict(1.25 * largest)
    assert verdict.answer == "validated"
    assert campaign.executions <= 20
    assert largest <= (verdict.bound or 0.0) <= 1.25 * largest
    assert len(set(names(campaign))) == campaign.executions
    assert_names(verdict.reason, 41)
    assert_names(str(verdict), 41, 41 - campaign.executions)
    tests = (verdict.certificate.details if verdict.certificate else {})["tests"]
    assert tests["drawn"] >= 8
    assert tests["share_missed"] is None  # they are drawn without replacement


def test_a_distance_above_the_threshold_ends_the_campaign() -> None:
    given = validation(FINE, lambda p: p.goal)
    largest = true_distances(given).max()
    campaign = Campaign(given, seed=0).run(41, 0.9 * largest)
    verdict = campaign.verdict(0.9 * largest)
    assert verdict.answer == "falsified"
    assert_names(verdict.reason, names(campaign)[-1])
    assert campaign.executions < 8


@pytest.mark.thorough
def test_a_noisy_task_is_not_repeated() -> None:
    noisy = systems.Imperfect(step, vectorized=True, process=[0.0, 0.02], seed=1)
    campaign = Campaign(validation(system=noisy), seed=0).run(50, 0.9)
    assert max(Counter(names(campaign)).values()) == 1


@pytest.mark.thorough
def test_a_resumed_campaign_makes_the_same_choices(tmp_path: Path) -> None:
    whole = Campaign(validation(), seed=3).run(5, 9.0)
    for budget in (3, 5):
        Campaign(validation(), seed=3, store=tmp_path / "parts.sqlite").run(budget, 9.0)
    again = Campaign(validation(), seed=3, store=tmp_path / "parts.sqlite")
    assert names(again) == names(whole)
    assert again.validation.space.names == COARSE.names


class Failing:
    """A system that cannot turn left by 3."""

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        if task.name == "left 3":
            raise RuntimeError("motor stalled")
        return systems.Simulated(step, vectorized=True).execute(controller, task)


def test_a_task_that_failed_is_left_to_people() -> None:
    campaign = Campaign(validation(system=Failing()), seed=0).run(50, 9.0)
    assert campaign.executions == 6
    verdict = campaign.verdict(9.0)
    assert verdict.answer == "undecided"
    assert_names(verdict.reason, 1, 6, "distance")
    opened = campaign.ask({"task": "left 3"})
    campaign.tell(opened.number, distance=0.5)
    assert campaign.verdict(9.0).answer == "validated"


def test_workers_execute_each_task_once() -> None:
    campaign = Campaign(validation(), seed=0).run(50, 9.0, workers=2)
    assert Counter(names(campaign)) == Counter(COARSE.task_names)


def test_people_are_given_each_task_once() -> None:
    campaign = Campaign(validation(), seed=0)
    opened = [campaign.ask() for _ in range(6)]
    assert {each.plan.task.name for each in opened} == set(COARSE.task_names)
    with refuses(InputError, "task"):
        campaign.ask()
    assert campaign.ask({"task": "left 1"}).plan.task.name == "left 1"


def test_what_needs_independent_draws_is_refused() -> None:
    campaign = Campaign(validation(), seed=0)
    for draw in (lambda: campaign.ask(draw=True), lambda: campaign.audit(3)):
        with refuses(CertificateError, "suite"):
            draw()
    for kind in (DistanceBound(), Audit()):
        with refuses((CertificateError, InputError), "suite"):
            campaign.run(5, 1.0, certificate=CertificateOptions(kind))
    assert not campaign.trials


def test_a_campaign_may_ask_for_the_whole_suite() -> None:
    given = validation(FINE, lambda p: p.goal)
    campaign = Campaign(given, search=Random(), seed=0).run(50, 9.0, certificate=CertificateOptions(WholeSuite()))
    assert campaign.executions == len(FINE)


def test_tables_have_the_parameters_of_tasks() -> None:
    pytest.importorskip("pandas")
    campaign = Campaign(validation(), seed=0).run(3, explore=True)
    frame = campaign.to_dataframe()
    assert frame["task"].tolist() == names(campaign)
    assert frame["size"].tolist() == [COARSE[name]["size"] for name in names(campaign)]
    assert frame["side"].tolist() == [COARSE[name]["side"] for name in names(campaign)]


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_tests_are_spread_over_the_values_of_every_parameter(seed: int) -> None:
    """A load that is other in an eighth of the suite, or in one category of four, is met before a validation."""
    heavy = TaskSuite(
        {f"{kind} {goal:g}": {"kind": kind, "goal": goal} for kind in "abcd" for goal in np.linspace(0.2, 2, 10)}
    )
    given = validation(heavy, lambda p: p.goal)
    campaign = Campaign(given, seed=seed).run(40, 9.0)
    drawn = [heavy[trial.parameters["task"]] for trial in campaign.trials if trial.origin == "spread"]  # type: ignore[index]
    assert len(drawn) == 8
    assert {each["kind"] for each in drawn} == set("abcd")
    goals = np.sort([float(each["goal"]) for each in drawn])
    assert np.diff([0.2, *goals, 2.0]).max() <= 2 * 1.8 / 8 + 0.2


@pytest.mark.parametrize("share", [1.25, 0.6, 1e-3])
@pytest.mark.parametrize("kind", [None, WholeSuite()])
def test_the_envelope_of_a_suite_that_was_executed_is_its_tasks_below_the_threshold(kind: Any, share: float) -> None:
    given = validation()
    distances = true_distances(given)
    threshold = share * distances.max()
    campaign = Campaign(given, search=Random(), seed=1).run(6)
    envelope = campaign.envelope(threshold, certificate=None if kind is None else CertificateOptions(kind))
    trusted = distances <= threshold
    assert envelope.doubt is None
    assert envelope.tasks == tuple(name for name, below in zip(COARSE.task_names, trusted, strict=True) if below)
    assert envelope.share == trusted.mean()
    for name, below, distance in zip(COARSE.task_names, trusted, distances, strict=True):
        assert envelope.bound({"task": name}) == pytest.approx(distance if below else np.inf, rel=1e-12)


def test_a_failed_task_of_a_suite_is_not_trusted() -> None:
    campaign = Campaign(validation(), search=Random(), seed=1).run(5)
    (name,) = set(COARSE.task_names) - set(names(campaign))
    campaign.add({"task": name}, failed="it fell")
    envelope = campaign.envelope(100.0)
    assert set(envelope.tasks or ()) == set(COARSE.task_names) - {name}


def test_a_law_of_the_distances_bounds_a_suite_whose_dynamics_take_too_long_to_learn() -> None:
    goals = TaskSuite({f"go to {goal:g}": {"goal": float(goal)} for goal in np.geomspace(0.5, 2, 41)})
    given = validation(goals, lambda p: p.goal)
    largest = true_distances(given).max()
    campaign = Campaign(given, seed=0).run(41, 1.25 * largest, thinking=1e-4)
    verdict = campaign.verdict(1.25 * largest, thinking=1e-4)
    assert verdict.answer == "validated"
    assert 18 <= campaign.executions <= 30
    assert (1 - 1e-9) * largest <= (verdict.bound or 0.0) <= 1.25 * largest
    certificate = verdict.certificate
    assert certificate is not None
    assert (certificate.kind, certificate.details["not_executed"]) == ("suite", 41 - campaign.executions)
    assert campaign.verdict(0.9 * campaign.trials.largest, thinking=1e-4).answer == "falsified"
