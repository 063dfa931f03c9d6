from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from ctxval.errors import InputError, ShapeError
from ctxval.searches import Random, SamplingDiscarding, Search
from facts import assert_names, refuses


def fresh(dimension: int = 2, seed: int = 0) -> Random:
    search = Random()
    search.reset(dimension, seed)
    return search


@given(st.integers(0, 10_000), st.integers(1, 5), st.lists(st.integers(1, 4), min_size=1, max_size=4))
def test_draws_depend_on_the_seed_and_their_index_alone(seed: int, dimension: int, groups: list[int]) -> None:
    one_by_one, grouped = fresh(dimension, seed), fresh(dimension, seed)
    singles = []
    for index in range(sum(groups)):
        singles.append(one_by_one.ask(1)[0])
        one_by_one.tell(singles[-1:], [float(index)] if index % 3 else [np.nan])
    np.testing.assert_array_equal(np.concatenate([grouped.ask(n) for n in groups]), singles)


def test_another_seed_draws_other_points() -> None:
    assert not np.isin(fresh(seed=0).ask(50), fresh(seed=1).ask(50)).any()


def test_draws_of_one_seed_do_not_repeat() -> None:
    assert len(np.unique(fresh(1).ask(500))) == 500


def test_draws_are_independent_and_uniform_over_the_cube() -> None:
    points = fresh(2, 11).ask(2000)
    assert ((points >= 0) & (points <= 1)).all()
    for column in points.T:
        assert kstest(column, "uniform").pvalue > 0.01
    np.testing.assert_allclose(np.corrcoef(points.T), np.eye(2), atol=0.06)
    # Neighbours in time are independent too, although each draw has a generator of its own.
    np.testing.assert_allclose(np.corrcoef(points[:-1, 0], points[1:, 0]), np.eye(2), atol=0.06)


def test_a_point_told_by_hand_takes_the_place_of_a_draw() -> None:
    plain, interrupted = fresh(), fresh()
    expected = plain.ask(4)
    np.testing.assert_array_equal(interrupted.ask(2), expected[:2])
    interrupted.tell([[0.5, 0.5]], [1.0])
    np.testing.assert_array_equal(interrupted.ask(1), expected[3:])


def test_points_and_values_are_kept_in_the_order_of_asking() -> None:
    search = fresh()
    asked = search.ask(3)
    search.tell(asked[[2, 0]], [20.0, 0.0])
    search.tell([[0.1, 0.2]], [7.0])
    np.testing.assert_array_equal(search.points, [*asked, [0.1, 0.2]])
    np.testing.assert_array_equal(search.values, [0.0, np.nan, 20.0, 7.0])


def test_a_pending_point_that_is_told_again_as_unknown_stays_one_point() -> None:
    search = fresh()
    asked = search.ask(1)
    search.tell(asked, [np.nan])
    search.tell(asked, [np.nan])
    assert len(search.points) == 1
    search.tell(asked, [3.0])
    assert search.values.tolist() == [3.0]


def test_a_point_that_is_known_may_be_evaluated_again() -> None:
    search = fresh()
    search.tell([[0.1, 0.2]], [1.0])
    search.tell([[0.1, 0.2]], [2.0])
    assert search.values.tolist() == [1.0, 2.0]


def test_a_reset_forgets_everything() -> None:
    search = fresh(2, 3)
    expected = search.ask(2)
    search.tell(expected, [1.0, 2.0])
    search.reset(2, 3)
    assert len(search.points) == len(search.values) == 0
    np.testing.assert_array_equal(search.ask(2), expected)
    search.reset(5, 3)
    assert search.dimension == 5
    assert search.ask(1).shape == (1, 5)


def test_random_points_are_iid_and_nothing_is_discarded() -> None:
    assert isinstance(Random(), Search)
    assert (Random.iid, Random.initial, Random.discard) == (True, 0, 0)


def test_sampling_and_discarding_draws_the_same_points_and_says_how_many_it_leaves_out() -> None:
    search = SamplingDiscarding(discard=3)
    search.reset(2, 0)
    np.testing.assert_array_equal(search.ask(5), fresh().ask(5))
    assert (search.iid, search.discard) == (True, 3)
    assert SamplingDiscarding(0).discard == 0


def test_a_negative_discard_is_refused_by_value() -> None:
    with refuses(InputError, "discard", 0, -1):
        SamplingDiscarding(-1)


@pytest.mark.parametrize("n", [0, -1])
def test_asking_for_no_point_is_refused_by_value(n: int) -> None:
    with refuses(InputError, "n", n):
        fresh().ask(n)


def test_a_cube_without_dimension_is_refused() -> None:
    with refuses(InputError, "dimension", 0):
        Random().reset(0, 0)


@pytest.mark.parametrize(
    ("points", "values"), [((2, 3), (2,)), ((2, 2), (3,)), ((2,), (1,)), ((1, 2), ()), ((2, 2), (2, 1))]
)
def test_points_and_values_that_do_not_fit_are_refused_with_both_shapes(
    points: tuple[int, ...], values: tuple[int, ...]
) -> None:
    search = fresh()
    with pytest.raises(ShapeError) as caught:
        search.tell(np.zeros(points), np.zeros(values))
    assert_names(str(caught.value), "tell", "points", points, values)
    assert len(search.points) == 0


def test_what_is_no_number_cannot_be_told() -> None:
    with refuses(InputError, "values", "high"):
        fresh().tell([[0.1, 0.2]], ["high"])
