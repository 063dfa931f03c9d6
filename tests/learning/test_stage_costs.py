"""The budget of a choice: costs follow from sizes and stored numbers, and stages are taken while they fit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval.learning.stage_costs import Costs, Ledger, Sizes, Speed, Thinking, ThinkingSettings, reduced, speed_to_json
from ctxval.learning.worst_case import WorstCaseSettings

SETTINGS = ThinkingSettings()
SPEED = Speed(1.0, 1e-3, 1e-4, 1e-4, 1e-5, True, False, 4, 2, 50)


def thinking(seconds: float = 5.0, **slower: float) -> Thinking:
    return Thinking(seconds, seconds, SPEED, tuple(slower.items()))


def costs(**changed: Any) -> Costs:
    return Costs(thinking(), replace(Sizes.of(SPEED, 2, 4, 0), **changed))


def ledger(seconds: float, **slower: float) -> Ledger:
    return Ledger(Costs(thinking(seconds, **slower), Sizes.of(SPEED, 2, 4, 0)))


def test_stages_are_taken_while_they_fit() -> None:
    book = ledger(5.0)
    assert book.fits("loops", lambda costs: 3.0)
    assert not book.fits("loops", lambda costs: 3.0)
    assert book.fits("loops", lambda costs: 1.0, reserve=1.0)
    assert not book.fits("loops", lambda costs: 0.5, reserve=1.0)
    assert book.left == 1.0
    assert book.expected == {"loops": 4.0}


def test_a_part_of_the_dynamics_that_is_left_out_is_said_and_keeps_the_reserve() -> None:
    book = ledger(5.0)
    book.reserve = 3.0
    assert book.learns("learning", "dry friction", lambda costs: 2.0)
    assert not book.learns("noise", "histories", lambda costs: 4.0)
    assert (book.replaced, book.incomplete, book.left) == (["histories"], 4.0, 3.0)
    assert book.to_json()["replaced"] == ["histories"]


def test_parts_of_the_dynamics_leave_time_for_the_smallest_search_until_it_is_taken() -> None:
    book = ledger(5.0)
    book.reserve, book.owed = 1.0, 3.0
    assert not book.learns("noise", "histories", lambda costs: 2.0)
    assert not book.optional("learning", "a parameter", lambda costs: 2.0)
    book.owed = 0.0
    assert book.learns("noise", "histories", lambda costs: 2.0)


def test_stages_without_which_a_verdict_stands_are_optional() -> None:
    book = ledger(1.0)
    assert not book.optional("loops", "pushes", lambda costs: 2.0)
    assert (book.replaced, book.incomplete) == (["pushes"], 0.0)


def test_without_a_budget_everything_fits_and_nothing_is_stored() -> None:
    book = Ledger()
    assert book.fits("loops", lambda costs: np.inf)
    assert book.learns("noise", "histories", lambda costs: np.inf)
    assert (book.left, book.to_json()) == (np.inf, {})


def test_stages_that_took_longer_before_are_expected_to_do_so_again() -> None:
    assert ledger(5.0, loops=2.0).seconds("loops", lambda costs: 1.5) == 3.0
    assert ledger(5.0, loops=2.0).seconds("noise", lambda costs: 1.5) == 1.5


@pytest.mark.parametrize(
    ("stated", "execution", "budgets"),
    [
        (None, None, (20.0, 60.0)),
        (None, 2.0, (20.0, 60.0)),
        (None, 40.0, (40.0, 120.0)),
        (None, np.inf, (60.0, 180.0)),
        (7.0, 20.0, (7.0, 7.0)),
    ],
)
def test_the_default_budget_is_one_execution(
    stated: float | None, execution: float | None, budgets: tuple[float, float]
) -> None:
    found = Thinking.after([], stated, execution, SPEED, SETTINGS)
    assert (found.seconds, found.decisive) == budgets


def test_corrections_multiply_within_bounds_and_small_stages_do_not_count() -> None:
    notes = [{"spent": {"loops": [2.0, 3.0], "noise": [0.01, 5.0]}}, {"spent": {"loops": [2.0, 3.0]}}]
    assert Thinking.after(notes, 5.0, None, SPEED, SETTINGS).slower == (("loops", 2.25),)
    most = Thinking.after([{"spent": {"loops": [1.0, 50.0]}}], 5.0, None, SPEED, SETTINGS)
    assert most.slower == (("loops", SETTINGS.slower[1]),)


@pytest.mark.parametrize("note", [{}, {"spent": None}, {"spent": {"loops": 3}}, {"spent": {"loops": ["a", None]}}])
def test_damaged_notes_correct_nothing(note: dict[str, Any]) -> None:
    assert Thinking.after([note], 5.0, None, SPEED, SETTINGS).slower == ()


def test_a_speed_is_stored_and_read_back() -> None:
    assert Speed.from_json(speed_to_json(SPEED)) == SPEED


@pytest.mark.parametrize(
    "values", [None, {}, 3, {**speed_to_json(SPEED), "step": "x"}, {**speed_to_json(SPEED), "step": -1}]
)
def test_damaged_speeds_are_none(values: Any) -> None:
    assert Speed.from_json(values) is None


def test_measured_speeds_know_the_sizes_of_the_experiment() -> None:
    speed = Speed.measured(make_validation(), np.random.default_rng(0).random((16, 1)), SETTINGS)
    assert speed is not None
    assert (speed.states, speed.inputs, speed.together, speed.batched) == (2, 1, True, True)
    assert speed.machine > 0


def test_costs_grow_with_their_sizes() -> None:
    full = WorstCaseSettings.for_dimension(2, batched=False)
    few = reduced(full, 0.25)
    assert costs().search(few) < costs().search(full)
    assert costs().filter() < 0.01 * costs(states=38, inputs=12).filter()
    assert costs().screening(full) < costs().screening(full, 10.0)
    assert costs().prediction(8) < costs().prediction(40)
    assert costs().whole(full, 20) < costs().whole(full, 40)


def test_controllers_cost_what_they_take_in_each_step() -> None:
    slow = Costs(replace(thinking(), speed=replace(SPEED, step=0.05)), Sizes.of(SPEED, 2, 4, 0))
    np.testing.assert_allclose(slow.plan(10) - costs().plan(10), 10 * 50 * (0.05 - 1e-4))
    alone = replace(slow, thinking=replace(slow.thinking, speed=replace(SPEED, step=0.05, together=False)))
    assert alone.run(8, 1) > 7.9 * slow.run(8, 1)
    batched = replace(slow, sizes=replace(slow.sizes, batched=True))
    assert batched.plan(64) < 0.1 * slow.plan(64)
