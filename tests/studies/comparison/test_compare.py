"""Comparisons of models, controllers and distances on one system."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import (
    Campaign,
    Comparison,
    Labels,
    Task,
    TaskSpace,
    TaskSuite,
    Validation,
    compare,
    controllers,
    distances,
    models,
    searches,
    systems,
)
from ctxval.campaign.storage.store import Store
from ctxval.core.plan import gives_inputs
from ctxval.core.trial_note import TrialNote
from ctxval.errors import InputError, UnknownNameError
from ctxval.studies.comparison import CandidateResult, PairResult
from ctxval.studies.comparison.candidates import ComparisonNote
from facts import assert_names, refuses
from rig_suites import COARSE
from rig_suites import validation as suite_of


def plant(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    drag = 0.3 * x[..., 1] * np.abs(x[..., 1])
    return np.stack([x[..., 0] + 0.05 * x[..., 1], x[..., 1] + 0.05 * (u[..., 0] - drag)], axis=-1)


class Counted(systems.Simulated):
    """The cart, which counts its executions."""

    executed = 0

    def execute(self, controller: Any, task: Task) -> Any:
        type(self).executed += 1
        return super().execute(controller, task)


def cart(
    weight: float = 1.0, distance: Any = None, mass: float = 1.0, limit: float = 2.0, horizon: int = 60
) -> Validation:
    return Validation(
        space=TaskSpace(goal=(-limit, limit, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=horizon, dt=0.05),
        system=Counted(plant, vectorized=True),
        model=models.Linear([[1, 0.05], [0, 1]], [[0], [0.05 / mass]]),
        synthesizer=controllers.LQR([weight, 1], [1 / weight]),
        distance=distance or distances.WholeTrajectory(norm=np.inf, components=[0]),
        labels=Labels(units="m"),
    )


def by_hand() -> Validation:
    rig = systems.Manual(states={"position": "m", "speed": "m/s"}, inputs={"force": "N"}, dt=0.1)
    return make_validation(system=rig)


def campaigns(**validations: Validation) -> dict[str, Campaign]:
    """Return campaigns with a search whose choices depend on no clock."""
    return {name: Campaign(one, search=searches.GPUCB()) for name, one in validations.items()}


FEW = TaskSuite({name: COARSE[name] for name in ("left 1", "right 1", "right 2")})


def suite(drag: float = 0.3) -> Validation:
    return suite_of(FEW, drag=drag)


@pytest.mark.slow
def test_the_controller_with_the_smaller_largest_distance_is_found() -> None:
    pair = {"gentle": cart(horizon=30), "stiff": cart(10.0, horizon=30)}
    found = compare(campaigns(**pair), question="worst", budget=30)
    truths = {name: one.distances(one.space.grid(401)).max() for name, one in pair.items()}
    assert found.decided
    assert found.ranking("worst") == ((min(truths, key=lambda name: truths[name]),), ("stiff",))
    decided = found.pair("worst", "stiff", "gentle")
    assert decided.smaller == "gentle"
    known = {one.name: one for one in found.candidates}
    assert truths["gentle"] <= (known["gentle"].bound or 0) < (known["stiff"].largest or 0) <= truths["stiff"] + 1e-12
    assert known["stiff"].bound is None
    assert known["stiff"].executions < 4  # only the better one needs a bound


@pytest.mark.thorough
def test_the_controller_with_the_smaller_expected_distance_is_found_by_the_same_tasks() -> None:
    pair = {"gentle": cart(), "stiff": cart(10.0)}
    made = campaigns(**pair)
    found = compare(made, question="mean", budget=80)
    means = {name: one.distances(one.space.grid(2001)).mean() for name, one in pair.items()}
    decided = found.pair("mean", "gentle", "stiff")
    assert decided.smaller == min(means, key=lambda name: means[name]) == "stiff"
    assert decided.low is not None
    assert decided.high is not None
    assert decided.low < means["gentle"] - means["stiff"] < decided.high
    points = [[trial.unit_point.tolist() for trial in one.trials] for one in made.values()]
    assert points[0] == points[1]
    assert {trial.origin for one in made.values() for trial in one.trials} == {"iid"}
    assert found.executions == 2 * decided.tasks


@pytest.mark.thorough
def test_distances_of_one_controller_share_every_execution() -> None:
    Counted.executed = 0
    pair = campaigns(whole=cart(), mean=cart(distance=distances.MeanDeviation(components=[0])))
    found = compare(pair, question="both", budget=8)
    whole, mean = found.candidates
    assert found.executions == Counted.executed == whole.executions + mean.executions
    assert whole.executions + whole.shared == mean.executions + mean.shared == found.executions
    trajectories = [
        {trial.number: one.trajectories(trial)[1] for trial in one.trials if trial.executed} for one in pair.values()
    ]
    assert [len(one) for one in trajectories] == [found.executions] * 2
    shared = [ComparisonNote.of(trial) for one in pair.values() for trial in one.trials]
    assert sum(note is not None and note.shared is not None for note in shared) == found.executions


@pytest.mark.slow
def test_models_with_other_numbers_in_the_same_controller_share_and_others_do_not() -> None:
    same = compare(campaigns(a=cart(), b=cart()), question="mean", budget=4)
    assert same.executions == 4
    assert [one.shared + one.executions for one in same.candidates] == [4, 4]
    assert not same.decided  # all differences are 0
    other = compare(campaigns(a=cart(), b=cart(mass=1.3)), question="mean", budget=2)
    assert [one.shared for one in other.candidates] == [0, 0]


def test_an_execution_agrees_only_with_the_controller_that_gave_its_inputs() -> None:
    one, other = cart(), cart(10.0)
    trajectory = one.outcome([1.0]).system_trajectory
    assert gives_inputs(one.plan([1.0]), trajectory, 1e-9)
    assert not gives_inputs(other.plan([1.0]), trajectory, 1e-9)
    assert not gives_inputs(make_validation().plan([1.0]), trajectory, 1e-9)

    def fails(t: int, x: np.ndarray) -> np.ndarray:
        raise ValueError("never here")

    assert not gives_inputs(replace(one.plan([1.0]), controller=fails), trajectory, 1e-9)


@pytest.mark.thorough
def test_a_comparison_that_is_stopped_continues_with_the_same_choices(tmp_path: Path) -> None:
    def stores(folder: str) -> dict[str, Campaign]:
        pair = {"gentle": cart(), "stiff": cart(10.0)}
        return {
            name: Campaign(one, search=searches.GPUCB(), store=tmp_path / folder / f"{name}.sqlite", name=name)
            for name, one in pair.items()
        }

    (tmp_path / "whole").mkdir()
    (tmp_path / "parts").mkdir()
    whole = compare(stores("whole"), budget=10)

    class StoppedError(Exception):
        pass

    for limit in (4,):
        seen: list[str] = []

        def stop(name: str, trial: object, limit: int = limit, seen: list[str] = seen) -> None:
            seen.append(name)
            if len(seen) == limit:
                raise StoppedError

        with pytest.raises(StoppedError):
            compare(stores("parts"), budget=10, on_trial=stop)
    parts = compare(stores("parts"), budget=10)
    assert parts.to_json() == whole.to_json()
    for name in ("gentle", "stiff"):
        kept = [Store(tmp_path / folder / f"{name}.sqlite").trials() for folder in ("whole", "parts")]
        plain = [[(t.unit_point.tolist(), t.distance, json.dumps(t.note.to_json())) for t in trials] for trials in kept]
        assert plain[0] == plain[1]
    again = compare(stores("parts"), budget=10)
    assert again.to_json() == whole.to_json()


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: {"a": cart()}, (1, "comparison")),
        (lambda: {"a": cart(), "b": cart(limit=3.0)}, ("b", "space.goal[0]")),
        (lambda: {"a": cart(), "b": make_validation()}, ("b", "space.goal[0]")),
        (lambda: {"a": by_hand(), "b": by_hand()}, ()),
        (lambda: {"a": cart(), "b": 3}, ("b", "candidates")),
        (lambda: [cart(), cart()], ("candidates", "m")),
        (
            lambda: {"a": cart(), "b": cart().with_parts(labels=Labels(units="mm"))},
            ("mm", "b"),
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(make: Callable[[], Any], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        compare(make())


def test_another_system_is_refused() -> None:
    other = make_validation(system=systems.Simulated(lambda x, u: x, vectorized=True))
    with refuses(InputError, "system", "b"):
        compare({"a": make_validation(), "b": other})


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({"question": "median"}, ("question", "median", "mean")),
        ({"budget": 0}, ("budget",)),
        ({"budget": 2.5}, ("budget",)),
        ({"seed": -1}, ("seed", -1)),
        ({"largest_possible": 0.0}, ("largest_possible",)),
        ({"largest_possible": float("nan")}, ("largest_possible",)),
        ({"confidence": 0.3}, ("confidence", 0.3)),
        ({"stochastic": True}, ("question", "stochastic", "both")),
        ({"stochastic": True, "question": "worst"}, ("question", "stochastic")),
    ],
)
def test_values_that_cannot_be_used_are_refused(options: dict[str, Any], facts: tuple[object, ...]) -> None:
    with refuses((InputError, UnknownNameError), *facts):
        compare({"a": cart(), "b": cart(10.0)}, **options)


@pytest.mark.parametrize("question", ["mean", "both"])
def test_a_distance_above_the_largest_possible_one_ends_the_comparison(tmp_path: Path, question: Any) -> None:
    with refuses(InputError, "largest_possible", 0.0001):
        compare({"a": cart(), "b": cart(10.0)}, question=question, budget=9, largest_possible=1e-4, stores=tmp_path)
    kept = [trial for name in "ab" for trial in Store(tmp_path / f"{name}.sqlite").trials()]
    assert max(trial.distance for trial in kept) > 1e-4


@pytest.mark.slow
@pytest.mark.thorough
def test_a_failed_draw_leaves_the_expected_distance_open_unless_a_largest_one_is_stated() -> None:
    def breaks(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        if np.abs(x[..., 0]).max() > 1.0:
            raise RuntimeError("the cart left the rail")
        return plant(x, u)

    def broken(weight: float) -> Validation:
        parts = {**vars(cart(weight, horizon=40)), "system": systems.Simulated(breaks)}
        return Validation(**parts)

    pair = {"gentle": broken(1.0), "stiff": broken(10.0)}
    open_ = compare(campaigns(**pair), question="mean", budget=12)
    assert not open_.decided
    assert sum(one.failed for one in open_.candidates) >= 1
    stated = compare(campaigns(**pair), question="mean", budget=6, largest_possible=1.0)
    assert stated.executions == 6
    assert_names(stated.assumptions, 1)


def comparison() -> Comparison:
    named = ("gp", "fnn", "<b>|linear")
    candidates = tuple(
        CandidateResult(name, 5, 1, 0, 0.1 * k + 0.1, {"y": 0.1}, None if k == 2 else 0.15 * k + 0.11, 3, 0.05 * k)
        for k, name in enumerate(named)
    )
    pairs = (
        PairResult("worst", "gp", "fnn", "gp", "a fact"),
        PairResult("worst", "gp", "<b>|linear", "gp", "a fact"),
        PairResult("worst", "fnn", "<b>|linear", None, "no bound separates them"),
        PairResult("mean", "gp", "fnn", "gp", "the interval", -0.02, -0.03, -0.01, 9, 0.2),
        PairResult("mean", "gp", "<b>|linear", None, "contains 0", 0.01, -np.inf, np.inf, 3),
        PairResult("mean", "fnn", "<b>|linear", "<b>|linear", "the interval", 0.02, 0.01, 0.03, 9, 0.2),
    )
    return Comparison(candidates, pairs, 0.95, 15, 75, "m", ("the system does not change",))


def test_a_ranking_groups_what_is_not_told_apart() -> None:
    found = comparison()
    assert found.ranking("worst") == (("gp",), ("fnn", "<b>|linear"))
    assert_names(found.ranking_text("worst"), "gp", "fnn")
    assert found.ranking("mean") == (("gp", "<b>|linear"), ("fnn",))
    assert not found.decided
    assert found.pair("mean", "fnn", "gp").smaller == "gp"
    assert found.pair("mean", "gp", "<b>|linear").smaller is None
    with pytest.raises(KeyError):
        found.pair("worst", "gp", "nothing")


def test_a_result_is_json_whatever_the_names_are() -> None:
    found = comparison()
    plain = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert plain["pairs"][4]["low"] is None
    assert plain["rankings"]["worst"] == [["gp"], ["fnn", "<b>|linear"]]


@pytest.mark.slow
def test_notes_of_others_are_no_notes_of_a_comparison() -> None:
    trial = Campaign(make_validation()).ask({"goal": 0.5}).trial
    for note in ({}, {"comparison": 3}, {"comparison": {"step": "x"}}, {"other": {}}):
        assert ComparisonNote.of(replace(trial, note=TrialNote.from_json(note))) is None
    kept = ComparisonNote(4, "mean", 2, 0.5, 0.25, ("a", 3))
    for stored in (kept.to_json(), json.loads(json.dumps(kept.to_json()))):
        found = ComparisonNote.of(replace(trial, note=TrialNote(comparison=stored)))
        assert found is not None
        assert vars(found) == vars(kept)


def test_a_comparison_is_decided_when_all_tasks_were_executed() -> None:
    candidates = {"little": suite(drag=0.3), "much": suite(drag=0.33)}
    truths = {name: each.distances(FEW.grid(2)).max() for name, each in candidates.items()}
    found = compare(candidates, budget=50)
    assert found.questions == ("worst",)
    assert found.decided
    assert found.pairs[0].smaller == min(truths, key=lambda name: truths[name])
    assert all(result.executions <= len(FEW) for result in found.candidates)


def test_candidates_that_are_equal_are_not_told_apart_by_a_suite() -> None:
    found = compare({"one": suite(), "other": suite()}, budget=50)
    assert not found.decided
    assert found.executions == len(FEW)  # one execution counts for both


def test_a_suite_has_no_expected_distance() -> None:
    with refuses(InputError, "question", "mean"):
        compare({"one": suite(), "other": suite(drag=0.1)}, question="mean")
