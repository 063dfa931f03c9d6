from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.gp.ascent import ascend, usual_effort


def maximum(function: object, dimension: int, budget: int = 1500, seed: int = 0) -> tuple[Array, float]:
    box = np.zeros(dimension), np.ones(dimension)
    points, values = ascend(function, box, budget, np.empty((0, dimension)), np.random.default_rng(seed))  # type: ignore[arg-type]
    return points[0], float(values[0])


@pytest.mark.parametrize("dimension", [1, 2, 6])
def test_it_finds_an_interior_maximum(dimension: int) -> None:
    point, _ = maximum(lambda X: -((X - 0.3) ** 2).sum(axis=1), dimension)
    np.testing.assert_allclose(point, 0.3, atol=0.02)


@pytest.mark.parametrize("dimension", [2, 11, 20])
def test_it_finds_a_corner_exactly(dimension: int) -> None:
    corner = (np.arange(dimension) % 3 > 0).astype(float)
    point, _ = maximum(lambda X: np.exp(-np.abs(X - corner).sum(axis=1)), dimension)
    np.testing.assert_array_equal(point, corner)


def test_it_finds_a_maximum_behind_jumps() -> None:
    point, _ = maximum(lambda X: np.floor(5 * X).sum(axis=1) + 0.1 * X.sum(axis=1), 4)
    np.testing.assert_array_equal(point, 1.0)


def test_it_stays_in_its_box_and_its_budget_and_sorts_what_it_saw() -> None:
    seen: list[Array] = []

    def function(X: Array) -> Array:
        seen.append(X)
        return X.sum(axis=1)

    low, high = np.array([0.2, 0.0, 0.1, 0.5]), np.array([0.4, 0.3, 0.9, 0.52])
    points, values = ascend(function, (low, high), 300, np.full((3, 4), 0.7), np.random.default_rng(0))
    asked = np.concatenate(seen)
    assert ((asked >= low - 1e-12) & (asked <= high + 1e-12)).all()
    assert len(asked) <= 1.2 * 300
    assert len(points) == len(values) == len(asked)
    assert (np.diff(values) <= 0).all()


@pytest.mark.parametrize("dimension", [2, 5])
def test_what_is_not_finite_is_no_maximum(dimension: int) -> None:
    point, value = maximum(lambda X: np.where(X[:, 0] > 0.5, np.nan, X[:, 0]), dimension)
    assert 0.45 < point[0] <= 0.5
    assert np.isfinite(value)
    _, nothing = maximum(lambda X: np.full(len(X), np.nan), dimension)
    assert nothing == -np.inf


@pytest.mark.parametrize("dimension", [4, 6])
def test_an_approximation_is_searched_and_the_function_itself_decides(dimension: int) -> None:
    asked: list[int] = []

    def exact(X: Array) -> Array:
        asked.append(len(X))
        return -((X - 0.3) ** 2).sum(axis=1)

    low, high = np.zeros(dimension), np.ones(dimension)
    rng, rough = np.random.default_rng(0), lambda X: -((X - 0.33) ** 2).sum(axis=1)
    points, values = ascend(exact, (low, high), 1000, np.empty((0, dimension)), rng, rough)
    assert sum(asked) == len(points) < 300
    np.testing.assert_allclose(points[0], 0.3, atol=0.05)
    np.testing.assert_allclose(values, -((points - 0.3) ** 2).sum(axis=1))


def test_in_few_dimensions_the_function_is_asked_for_the_same_points_each_time() -> None:
    asked: list[Array] = []

    def function(X: Array) -> Array:
        asked.append(X)
        return np.sin(9 * X).prod(axis=1)

    for seed, low in enumerate([0.0, 0.4]):
        ascend(function, (np.full(2, low), np.ones(2)), 600, np.empty((0, 2)), np.random.default_rng(seed))
    pools = [points for points in asked if len(points) == 200]
    assert len(pools) == 2
    np.testing.assert_array_equal(*pools)
    assert pools[0].min() == 0.0
    assert pools[0].max() == 1.0


def test_the_same_randomness_finds_the_same_points() -> None:
    first, again = (maximum(lambda X: np.sin(9 * X).prod(axis=1), 5, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first[0], again[0])


@pytest.mark.parametrize("dimension", [1, 2, 3, 4, 11])
@pytest.mark.parametrize("budget", [60, 150, 400, 2000])
def test_the_usual_effort_is_about_that_of_a_search(dimension: int, budget: int) -> None:
    seen: dict[str, list[int]] = {"exact": [], "rough": []}

    def counted(kind: str) -> Callable[[Array], Array]:
        def function(X: Array) -> Array:
            seen[kind].append(len(X))
            return np.asarray(np.exp(-np.abs(X - 0.3).sum(axis=1)))

        return function

    starts = np.random.default_rng(1).random((8, dimension))
    box = np.zeros(dimension), np.ones(dimension)
    ascend(counted("exact"), box, budget, starts, np.random.default_rng(0), counted("rough"))
    usual, batches = usual_effort(dimension, budget), sum(map(len, seen.values()))
    points = usual.exact + usual.rough
    assert points <= budget
    assert 0.6 * points <= sum(map(sum, seen.values())) <= 1.6 * points
    assert 0.6 * usual.rough <= sum(seen["rough"]) <= 1.6 * usual.rough
    assert 0.5 * usual.batches <= batches <= 2 * usual.batches
