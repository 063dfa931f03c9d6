"""Tasks whose controllers jump are not executed, whatever the synthesizer, the search and the engine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Task, Validation, controllers, searches
from ctxval._util.arrays import Array
from ctxval.campaign.proposals import DesignContinuity
from ctxval.core.controller import AffineFeedback, Controller
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.learning.closed_loops import LoopPlanner
from facts import refuses
from rig_thorough import more

ACCIDENTS = 0.4
"""Share of the tasks with an accident."""


class Accidental:
    """A synthesizer whose feedback is lost at some tasks, by the last digits of their goals."""

    batched = True

    def __init__(self, share: float = ACCIDENTS) -> None:
        self.share = share
        self.inner = controllers.ILQR([1.0, 0.1], [1e-2], [10.0, 1.0])

    def design(self, task: Task, model: Model) -> Controller:
        found = self.inner.design(task, model)
        digits = np.abs(np.modf(np.asarray(task.goal)[..., 0] * 7.3e9)[0])
        lost = digits < self.share
        gains = np.where(lost[..., None, None, None], 0.0, found.gains)
        return AffineFeedback(gains, found.inputs, found.states, converged=found.converged & ~lost)


def accidental(share: float = ACCIDENTS) -> Validation:
    whole = make_validation()
    return Validation(**{**vars(whole), "synthesizer": Accidental(share)})


def is_accident(validation: Validation, goal: float) -> bool:
    plan = validation.plan([goal])
    return not np.any(plan.controller.gains)  # type: ignore[attr-defined]


@pytest.mark.parametrize("predicted", [False, True])
def test_a_task_is_steady_if_its_neighbours_are_like_it(predicted: bool) -> None:
    validation = accidental()
    planner, space = LoopPlanner(validation), validation.space

    def expected(points: Array) -> Array:
        return validation.distances(space.from_unit(points))

    steady = DesignContinuity(planner, expected if predicted else None)
    points = np.random.default_rng(0).random((20, 1))
    for point in points:
        rounded = space.rounded(point)
        near = np.stack([point, rounded, rounded + np.where(rounded > 0.5, -1e-9, 1e-9)])
        lost = {is_accident(validation, float(goal)) for (goal,) in space.from_unit(near)}
        assert steady(point) == (len(lost) == 1)
    assert 0 < steady.rejected < 20
    smooth = DesignContinuity(LoopPlanner(make_validation()))
    assert all(map(smooth, points))
    assert not smooth.rejected


@pytest.mark.parametrize("search", [searches.GPUCB(), searches.CMAES(), searches.Auto("fast")])
def test_the_tasks_of_a_search_are_steady(search: searches.Search) -> None:
    campaign = Campaign(accidental(), search=search, seed=2).run(6, explore=True)
    steady = DesignContinuity(LoopPlanner(campaign.validation))
    rejected = [trial.note.unsteady or 0 for trial in campaign.trials]
    assert sum(rejected) > 0 or isinstance(search, searches.Auto)  # which executes bounds here
    assert all(map(steady, (trial.unit_point for trial in campaign.trials)))
    space = campaign.validation.space
    for trial in campaign.trials:
        assert float(f"{trial.parameters['goal']:.9g}") == trial.parameters["goal"]
        np.testing.assert_array_equal(space.from_unit(trial.unit_point), space.point(trial.parameters))
        assert campaign.validation.outcome(space.point(trial.parameters)).distance == trial.distance


@pytest.mark.parametrize("search", [searches.CMAES(), *more(searches.Auto("fast"))])
def test_a_resumed_campaign_chooses_the_same_tasks(search: searches.Search, tmp_path: Path) -> None:
    def tasks(campaign: Campaign) -> list[Any]:
        return [(trial.parameters, trial.unit_point.tolist(), trial.note) for trial in campaign.trials]

    whole = Campaign(accidental(0.2), search=search, seed=1).run(5, explore=True)
    for budget in (1, 3, 4, 5):
        campaign = Campaign(accidental(0.2), search=search, store=tmp_path / "a.sqlite", seed=1)
        campaign.run(budget, explore=True)
        campaign.store.close()
    assert tasks(campaign) == tasks(whole)


@pytest.mark.parametrize("search", [searches.Random(), searches.GPUCB()])
def test_independent_draws_and_tasks_of_people_are_never_rejected(search: searches.Search) -> None:
    campaign = Campaign(accidental(), search=search, seed=2).audit(12)
    assert all(trial.note.unsteady is None for trial in campaign.trials)
    assert all(float(f"{trial.parameters['goal']:.9g}") == trial.parameters["goal"] for trial in campaign.trials)
    goals = [2.123456789012345, 0.1 + 0.2, -1e-7 / 3, 1.9059017468190245]
    for goal in goals:
        opened = campaign.ask({"goal": goal})
        assert opened.trial.parameters == {"goal": goal}
        assert opened.plan.parameters.points.tolist() == [goal]
        assert campaign.reopen(opened.number).plan.task.goal[0] == goal
        campaign.tell(opened, distance=0.1)
    added = campaign.add({"goal": goals[0] / 3}, distance=0.2)
    assert added is not None
    assert added.parameters == {"goal": goals[0] / 3}
    if not isinstance(search, searches.Random):
        assert campaign.ask().trial.origin == "acquisition"


def test_if_no_task_is_steady_the_first_one_is_executed() -> None:
    class Chaotic(Accidental):
        def design(self, task: Task, model: Model) -> Controller:
            found = self.inner.design(task, model)
            factor = 2 * np.abs(np.modf(np.asarray(task.goal)[..., 0] * 7.3e11)[0])
            return AffineFeedback(found.gains * factor[..., None, None, None], found.inputs, found.states)

    whole = make_validation()
    campaign = Campaign(Validation(**{**vars(whole), "synthesizer": Chaotic()}), search=searches.GPUCB()).run(3)
    assert campaign.executions == 3
    assert sum(trial.note.unsteady or 0 for trial in campaign.trials) > 10


class Broken:
    """A synthesizer that fails as users' code may."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def design(self, task: Task, model: Model) -> Controller:
        raise self.error


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(3), InputError("no")])
def test_a_design_that_fails_is_reported_when_the_task_is_planned(error: BaseException) -> None:
    whole = make_validation()
    planner = LoopPlanner(Validation(**{**vars(whole), "synthesizer": Broken(error)}))
    assert DesignContinuity(planner)(np.array([0.3]))


def test_the_note_of_a_search_has_no_keys_of_the_campaign() -> None:
    class Noting(searches.GPUCB):
        def note(self) -> dict[str, Any]:
            return {"unsteady": 3}

    with refuses(InputError, "search"):
        Campaign(make_validation(), search=Noting()).run(1)


class Told:
    """A controller whose attribute ``converged`` is something else."""

    def __init__(self, inner: Controller) -> None:
        self.inner = inner

    def __call__(self, t: int, x: Array) -> Array:
        return np.asarray(self.inner(t, x))

    def converged(self) -> bool:
        raise RuntimeError("this is no attribute")


def test_a_campaign_notes_whether_designs_converged() -> None:
    class Other(controllers.LQR):
        batched = False

        def design(self, task: Task, model: Model) -> Controller:  # type: ignore[override]
            return Told(super().design(task, model))

    hasty = controllers.ILQR([1.0, 0.1], [1e-2], [10.0, 1.0], limits=0.5, iterations=1)
    for synthesizer, expected in ((hasty, False), (Other([1.0, 0.1], [1e-2]), None)):
        validation = Validation(**{**vars(make_validation()), "synthesizer": synthesizer})
        campaign = Campaign(validation, search=searches.Random()).run(2)
        assert [trial.note.converged for trial in campaign.trials] == [expected] * 2


def switching(t: int, x: Array, task: Task) -> Array:
    """A user's policy that loses its feedback at some tasks."""
    lost = np.abs(np.modf(np.asarray(task.goal)[..., :1] * 7.3e9)[0]) < ACCIDENTS
    return np.where(lost, 0.0, -3.0) * (x - task.goal)[..., :1]


@pytest.mark.parametrize(
    ("synthesizer", "jumps"),
    [
        (controllers.LQR([1.0, 0.1], [1e-2]), False),
        (controllers.MPC([1.0, 0.1], [1e-2], steps=5, limits=2.0), False),
        (controllers.Policy(lambda t, x, task: -3.0 * (x - task.goal)[..., :1]), False),
        (controllers.Policy(switching), True),
        (controllers.Policy(switching, vectorized=False), True),
    ],
    ids=["LQR", "MPC", "policy", "switching policy", "switching policy, one task at a time"],
)
def test_every_synthesizer_is_tested_in_the_same_way(synthesizer: Any, jumps: bool) -> None:
    validation = Validation(**{**vars(make_validation(horizon=12)), "synthesizer": synthesizer})
    steady = DesignContinuity(LoopPlanner(validation))
    found = [steady(point) for point in np.random.default_rng(1).random((12, 1))]
    assert (0 < steady.rejected < 12) if jumps else all(found)
