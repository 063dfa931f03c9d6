from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval._util.describe import describe
from ctxval.errors import InputError
from ctxval.searches import Auto, BayesianOptimisation, Prediction, Random, TrustRegion
from ctxval.searches.base import Note, Pending
from facts import refuses

Function = Callable[[Array], Array]


def varied(**settings: Any) -> TrustRegion:
    search = TrustRegion()
    vars(search).update(settings)
    return search


def hill(X: Array) -> Array:
    """Return a function whose maximum, 1.0, is at (0.3, 0.8, ...)."""
    return np.exp(-4 * ((X - np.resize([0.3, 0.8], X.shape[1])) ** 2).sum(axis=1))


def predicting(guess: Function, doubt: Function | None = None, known: Array | None = None) -> Prediction:
    def expected(X: Array) -> tuple[Array, Array]:
        return guess(X), np.full(len(X), 0.01) if doubt is None else doubt(X)

    def left_out(points: Array) -> Array:
        return np.zeros(len(points)) if known is None else guess(points)

    return Prediction(expected, left_out, budget=600)


def run(
    search: TrustRegion,
    function: Function,
    guess: Function,
    budget: int,
    dimension: int = 2,
    seed: int = 0,
    doubt: Function | None = None,
) -> Array:
    search.reset(dimension, seed)
    for _ in range(budget):
        known = search.points[np.isfinite(search.values)]
        search.use_prediction(predicting(guess, doubt, known))
        point = search.ask(1)
        search.tell(point, function(point))
    return search.values


@pytest.mark.parametrize("dimension", [1, 2, 6])
def test_a_right_prediction_leads_straight_to_the_top(dimension: int) -> None:
    assert run(TrustRegion(), hill, hill, 2, dimension)[0] > 0.99


def test_a_prediction_that_is_too_small_by_a_factor_does_as_well() -> None:
    assert run(TrustRegion(), hill, lambda X: 0.3 * hill(X), 2)[0] > 0.99


def test_a_wrong_prediction_does_not_keep_the_top_hidden() -> None:
    search = TrustRegion()
    assert run(search, hill, lambda X: 1.0 - 0.9 * hill(X), 25).max() > 0.97
    fallen = [note for note in search.notes if note is not None and note["engine"] == "scalar"]
    assert fallen


def engines(search: TrustRegion) -> list[str]:
    return [note["engine"] for note in search.notes if note is not None]


def doubtful(X: Array) -> Array:
    return np.full(len(X), 7.0)


def test_if_doubtful_predictions_were_far_off_every_second_point_is_that_of_the_surrogate() -> None:
    search = TrustRegion()
    run(search, hill, lambda X: 220.0 * X[:, 0] ** 4, 6, doubt=doubtful)
    assert engines(search) == ["climb", "climb", "scalar", "climb", "scalar", "climb"]
    never = varied(hedge=False)
    run(never, hill, lambda X: 220.0 * X[:, 0] ** 4, 5, doubt=doubtful)
    assert engines(never) == ["climb"] * 5


@pytest.mark.parametrize("doubt", [None, doubtful])
def test_right_predictions_are_not_hedged(doubt: Function | None) -> None:
    search = TrustRegion()
    run(search, hill, lambda X: 0.8 * hill(X), 4, doubt=doubt)
    assert engines(search) == ["climb"] * 4


def test_predictions_that_find_nothing_larger_are_hedged_though_they_are_right() -> None:
    search = varied(compare_with_surrogate=False)

    def plain(X: Array) -> Array:
        return np.exp(-4 * ((X - 0.2) ** 2).sum(axis=1))

    values = run(search, lambda X: plain(X) + 3 * (X > 0.75).all(axis=1), plain, 30)
    assert engines(search)[:6] == ["climb"] * 6
    assert "scalar" in engines(search)
    assert values.max() > 3


def test_without_a_prediction_the_scalar_search_goes_on_and_says_so() -> None:
    search, random = TrustRegion(), Random()
    search.reset(2, 5)
    random.reset(2, 5)
    np.testing.assert_array_equal(search.ask(1), random.ask(1))
    note = search.note()
    assert note is not None
    assert (note["engine"], note["how"]) == ("scalar", "initial")


def test_a_prediction_of_nothing_is_none() -> None:
    search = TrustRegion()
    search.reset(2, 0)
    search.use_prediction(predicting(lambda X: np.full(len(X), np.nan)))
    assert np.isfinite(search.ask(1)).all()
    note = search.note()
    assert note is not None
    assert (note["engine"], note["how"]) == ("scalar", "initial")


def test_doubt_draws_the_search_to_what_was_not_seen() -> None:
    def doubt(X: Array) -> Array:
        return np.where(X[:, 0] > 0.9, 5.0, 0.0)

    search = TrustRegion()
    search.reset(2, 0)
    search.use_prediction(predicting(lambda X: 1.0 + 0.1 * X[:, 1], doubt))
    assert search.ask(1)[0, 0] > 0.9


def test_a_wrong_prediction_shrinks_the_box_and_misses_end_the_climb() -> None:
    search = TrustRegion(misses=2)
    run(search, lambda X: 0.1 + 1e-6 * X[:, 0], lambda X: 1.0 + X[:, 0], 5)
    notes = [note for note in search.notes if note is not None and note["engine"] == "climb"]
    assert notes[0]["radius"] == notes[1]["radius"] == 1.0
    assert notes[2]["radius"] == 0.5
    assert max(note["climb"] for note in notes) >= 1


@pytest.mark.parametrize("dimension", [1, 2, 4])
@pytest.mark.parametrize("factor", [0.95, 1.0, 1.1])
def test_copies_of_executed_points_are_rare(dimension: int, factor: float) -> None:
    search = TrustRegion()
    run(search, hill, lambda X: factor * hill(X), 20, dimension)
    gaps = [np.abs(search.points[:k] - search.points[k]).max(axis=1).min() for k in range(1, 20)]
    copies = np.flatnonzero(np.array(gaps) <= search.settings.near) + 1
    gained = search.values[copies] > np.maximum.accumulate(search.values)[copies - 1]
    assert len(copies) <= 1 or gained.all()


@pytest.mark.parametrize(("moved", "is_executed"), [(1e-2, True), (5e-5, False)])
def test_a_copy_is_executed_if_it_is_predicted_to_be_larger(moved: float, is_executed: bool) -> None:
    def ramp(X: Array) -> Array:
        return X.sum(axis=1)

    search, known = TrustRegion(), np.full((1, 4), 1 - moved)
    search.reset(4, 0)
    search.tell(known, ramp(known))
    search.use_prediction(predicting(ramp))
    assert bool(np.abs(search.ask(1) - known).max() <= search.settings.near) is is_executed


def test_no_point_is_asked_twice_and_what_failed_is_kept_away_from() -> None:
    def holed(X: Array) -> Array:
        return np.where(np.linalg.norm(X - [0.3, 0.8], axis=1) < 0.1, np.nan, hill(X))

    search = TrustRegion()
    run(search, holed, hill, 15)
    gaps = np.abs(search.points[:, None] - search.points[None]).max(axis=2) + np.eye(15)
    assert gaps.min() > 1e-6
    failed = search.points[np.isnan(search.values)]
    climbs = [note is not None and note["engine"] == "climb" for note in search.notes]
    for point in failed:
        later = search.points[np.flatnonzero((search.points == point).all(axis=1))[0] + 1 :]
        near = np.linalg.norm(later - point, axis=1) < 0.05 * np.sqrt(2)
        assert not near[np.array(climbs[-len(later) :], dtype=bool)].any()


def test_a_batch_of_questions_spreads() -> None:
    search = TrustRegion()
    search.reset(2, 0)
    search.use_prediction(predicting(hill))
    asked = search.ask(4)
    gaps = [np.linalg.norm(asked[i] - asked[j]) for i in range(4) for j in range(i)]
    assert min(gaps) > 0.05


def test_without_any_prediction_it_goes_on_as_the_scalar_search_does() -> None:
    search, scalar = TrustRegion(), BayesianOptimisation(initial=1)
    for each in (search, scalar):
        each.reset(3, 4)
        for _ in range(6):
            point = each.ask(1)
            each.tell(point, hill(point))
    np.testing.assert_array_equal(search.points, scalar.points)


def test_a_prediction_that_is_no_good_is_replaced_by_the_one_it_names() -> None:
    asked: list[int] = []

    def wrong(known: Array) -> Prediction:
        def otherwise() -> Prediction:
            asked.append(len(known))
            return predicting(hill, known=known)

        return replace(predicting(lambda X: 1.0 - 0.9 * hill(X), known=known), otherwise=otherwise)

    search = TrustRegion()
    search.reset(2, 0)
    for _ in range(10):
        search.use_prediction(wrong(search.points))
        point = search.ask(1)
        search.tell(point, hill(point))
    assert asked
    assert min(asked) >= 6  # it is not computed before it is needed
    assert search.values.max() > 0.99
    assert all(note is not None and note["engine"] == "climb" for note in search.notes)


@pytest.mark.parametrize("told", [1, 3, 6])
def test_told_its_history_with_its_notes_it_asks_for_the_same_point(told: int) -> None:
    whole = TrustRegion()
    run(whole, hill, lambda X: 0.5 * hill(X - 0.1), 7)
    fresh = TrustRegion()
    fresh.reset(2, 0)
    fresh.tell(whole.points[:told], whole.values[:told])
    stored: list[Note | None] = json.loads(json.dumps(whole.notes[:told]))
    fresh.remember(stored)
    fresh.use_prediction(predicting(lambda X: 0.5 * hill(X - 0.1), known=whole.points[:told]))
    np.testing.assert_array_equal(fresh.ask(1)[0], whole.points[told])
    assert fresh.note() == whole.notes[told]


def test_a_reset_forgets_the_prediction() -> None:
    search = TrustRegion()
    run(search, hill, hill, 2)
    search.reset(2, 0)
    search.ask(1)
    note = search.note()
    assert note is not None
    assert (note["engine"], note["how"]) == ("scalar", "initial")


@pytest.mark.parametrize(
    ("options", "facts"),
    [({"optimism": -1.0}, ("optimism", -1.0)), ({"misses": 0}, (0, "misses"))],
)
def test_options_that_cannot_be_are_refused_by_value(options: dict[str, float], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        TrustRegion(**options)  # type: ignore[arg-type]


def test_settings_leave_parts_of_the_search_out() -> None:
    def wrong(X: Array) -> Array:
        return 1.0 - 0.9 * hill(X)

    def used(**settings: Any) -> set[str]:
        search = varied(**settings)
        run(search, hill, wrong, 12)
        return set(engines(search))

    def regions(**settings: Any) -> set[tuple[int, float]]:
        search = varied(**settings)
        run(search, hill, lambda X: 0.8 * hill(X), 6)
        return {(note["climb"], note["radius"]) for note in search.notes if note is not None and "climb" in note}

    assert used() == {"climb", "scalar"}
    assert used(compare_with_surrogate=False, hedge=False) == {"climb"}
    assert len(regions()) > 1
    assert regions(restrict=False) == {(0, 1.0)}


def test_a_store_has_what_is_set_otherwise() -> None:
    assert describe(TrustRegion()) == {"type": "TrustRegion", "optimism": 2.0, "misses": 3}
    assert describe(Auto()) == {"type": "Auto", "optimism": 2.0, "misses": 3, "thinking": "balanced"}
    other = describe(varied(boldness=1.0))
    assert other["boldness"] == 1.0


def asked_while_pending(at: list[float], after: Function) -> Array:
    """Return the point that is asked for while another one is being evaluated, which leads to another prediction."""
    search, pending = TrustRegion(), np.array([at])
    search.reset(2, 0)
    search.tell(np.array([[0.9, 0.1], *pending]), [0.2, np.nan])
    search.use_prediction(replace(predicting(hill), pending=Pending(pending, lambda: predicting(after))))
    return search.ask(1)[0]


def test_a_pending_point_does_not_delay_what_is_best_without_it() -> None:
    np.testing.assert_allclose(asked_while_pending([0.9, 0.9], lambda X: 1 - X[:, 0]), [0.3, 0.8], atol=0.02)


def test_if_the_best_point_is_pending_the_next_one_is_chosen_as_if_it_were_known() -> None:
    found = asked_while_pending([0.3, 0.8], lambda X: 2.0 - ((X - [0.7, 0.3]) ** 2).sum(axis=1))
    np.testing.assert_allclose(found, [0.7, 0.3], atol=0.02)


def test_a_pending_point_that_is_expected_to_be_small_is_no_miss_before_it_is_known() -> None:
    search = TrustRegion(misses=1)
    search.reset(2, 0)
    search.use_prediction(predicting(hill))
    first = search.ask(1)
    search.tell(first, hill(first))
    search.tell(np.array([[0.9, 0.1]]), [np.nan])
    search.remember([search.notes[0], {**(search.notes[0] or {}), "expected": 0.1}])
    pending = Pending(np.array([[0.9, 0.1]]), lambda: predicting(hill))
    search.use_prediction(replace(predicting(lambda X: 2 * hill(X)), pending=pending))
    search.ask(1)
    assert (search.note() or {})["climb"] == 0
