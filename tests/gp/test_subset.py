"""What is kept of a long history: everything that a search needs of it, and few enough."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from ctxval import searches
from ctxval._util.arrays import Array
from ctxval.gp.cholesky import pivoted_cholesky, pivoted_rows
from ctxval.gp.kernels import Matern
from ctxval.gp.surrogate import LONG, kept_rows
from rig_thorough import more

UNCUT = [("gp-ucb", 1), ("gp-ucb", 20), ("bayesian-optimisation", 1), ("bayesian-optimisation", 2)]


def long_history(count: int, dimension: int = 2, failed: int = 0) -> tuple[Array, Array]:
    """Return points, half of them in one corner, and their values."""
    rng = np.random.default_rng(0)
    points = rng.random((count, dimension))
    points[::2] *= 0.05
    values = np.sin(5 * points[:, 0]) + points[:, -1]
    values[rng.permutation(count)[:failed]] = np.nan
    return points, values


def test_all_of_a_short_history_is_kept() -> None:
    points, values = long_history(LONG - 1, failed=100)
    np.testing.assert_array_equal(kept_rows(points, values, 10), np.arange(LONG - 1))


@pytest.mark.parametrize("failed", [0, 500, 2998])
def test_a_long_history_keeps_the_largest_and_the_latest_and_is_covered(failed: int) -> None:
    points, values = long_history(3000, failed=failed)
    rows = kept_rows(points, values, 400)
    assert len(np.unique(rows)) == 400
    assert (np.diff(rows) > 0).all()
    largest = np.argsort(-np.nan_to_num(values, nan=-np.inf), kind="stable")[: min(100, 3000 - failed)]
    assert set(largest) <= set(rows)
    assert set(range(2900, 3000)) <= set(rows)
    assert np.isfinite(values[rows]).sum() >= 2
    # Nothing that was looked at is far from what is kept; 400 random rows leave gaps more than twice as wide.
    assert cdist(points, points[rows]).min(axis=1).max() < 0.07


def test_copies_of_one_point_are_no_reason_to_stop() -> None:
    points, values = np.full((LONG, 3), 0.5), np.zeros(LONG)
    assert len(np.unique(kept_rows(points, values, 900))) == 900


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "dimension"),
    [("gp-ucb", 2), ("bayesian-optimisation", 20), *more(*UNCUT)],
)
def test_a_search_goes_on_over_a_long_history_as_one_never_stopped(name: str, dimension: int) -> None:
    points, values = long_history(LONG + 3, dimension, failed=50)

    def asked() -> Array:
        search = searches.by_name(name)
        search.reset(dimension, 4)
        search.tell(points[: LONG - 2], values[: LONG - 2])
        search.tell(points[LONG - 2 :], values[LONG - 2 :])
        proposed = search.ask(2)
        assert ((proposed >= 0) & (proposed <= 1)).all()
        assert cdist(proposed, points).min() > 1e-6
        return proposed

    np.testing.assert_array_equal(asked(), asked())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gp-ucb", "bayesian-optimisation"])
def test_a_long_history_leads_to_the_maximum_too(name: str) -> None:
    rng = np.random.default_rng(1)
    points = rng.random((LONG + 100, 2)) * [0.6, 1.0]  # the peak is where none of them is
    search = searches.by_name(name)
    search.reset(2, 0)

    def height(x: Array) -> Array:
        return np.asarray(np.exp(-20 * ((x - [0.8, 0.4]) ** 2).sum(axis=1)))

    search.tell(points, height(points))
    for _ in range(20):
        point = search.ask(1)
        search.tell(point, height(point))
        if height(point).max() > 0.95:
            return
    pytest.fail("the peak was not found in 20 suggestions")


def test_a_surrogate_of_a_long_history_has_its_best_point() -> None:
    points, values = long_history(2000)
    search = searches.GPUCB()
    search.reset(2, 0)
    search.tell(points, values)
    surrogate = search.surrogate()
    assert len(surrogate.process.y) == 500
    mean, deviation = surrogate.predict(points[[values.argmax()]])
    assert mean[0] == pytest.approx(values.max(), abs=0.01)
    assert deviation[0] < 0.01


def test_each_pivot_has_the_largest_variance_that_those_before_it_leave() -> None:
    kernel, theta = Matern(2.5), np.log([2.0, 0.6])
    X = np.random.default_rng(0).random((30, 2))
    rows = pivoted_rows(kernel, theta, X, 8, least=0.0)
    K = kernel(theta, X, X)
    for count in range(1, 8):
        before = rows[:count]
        left = np.diag(K - K[:, before] @ np.linalg.solve(K[np.ix_(before, before)], K[before]))
        assert left[rows[count]] == pytest.approx(left.max(), rel=1e-6)


def test_pivots_end_where_the_others_add_nothing() -> None:
    X = np.repeat(np.random.default_rng(0).random((3, 2)), 5, axis=0)
    assert len(pivoted_rows(Matern(), np.log([1.0, 0.5]), X, 10, least=1e-9)) == 3


@given(st.integers(0, 2**32 - 1), st.integers(0, 12), st.integers(1, 12))
def test_a_pivoted_factor_is_that_of_the_chosen_rows(seed: int, count: int, rank: int) -> None:
    root = np.random.default_rng(seed).normal(size=(12, rank))
    matrix = root @ root.T
    found = pivoted_cholesky(np.diag(matrix), lambda row: matrix[row].copy(), count, least=1e-9)
    assert len(found.rows) == min(count, rank)
    chosen = matrix[np.ix_(found.rows, found.rows)]
    np.testing.assert_allclose(found.L @ found.L.T, chosen, atol=1e-8)
    np.testing.assert_array_equal(np.triu(found.L, 1), 0.0)
    others = matrix[found.rows]
    left = matrix - others.T @ np.linalg.pinv(chosen, rcond=1e-12) @ others if count else matrix
    np.testing.assert_allclose(found.left, np.maximum(np.diag(left), 0.0), atol=1e-5 * np.trace(matrix))
