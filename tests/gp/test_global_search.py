from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval._util.arrays import Array
from ctxval.gp.global_search import GlobalMaximum, search_globally
from rig_thorough import more

Values = Callable[[Array], Array]


def search(function: Values, dimension: int, seed: int = 0, evaluations: int = 3000) -> GlobalMaximum:
    starts = np.empty((0, dimension))
    return search_globally(function, dimension, starts, np.random.default_rng(seed), evaluations=evaluations)


def hartmann(points: Array) -> Array:
    """Return Hartmann's function of six variables, whose maximum is 3.32237 (Dixon and Szegö 1978)."""
    weights = np.array([1.0, 1.2, 3.0, 3.2])
    curvatures = np.array(
        [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14], [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
    )
    centres = 1e-4 * np.array(
        [
            [1312, 1696, 5569, 124, 8283, 5886],
            [2329, 4135, 8307, 3736, 1004, 9991],
            [2348, 1451, 3522, 2883, 3047, 6650],
            [4047, 8828, 8732, 5743, 1091, 381],
        ]
    )
    return np.asarray(np.exp(-(curvatures * (points[:, None] - centres) ** 2).sum(axis=2)) @ weights)


def branin(points: Array) -> Array:
    """Return Branin's function with its sign changed; its three maxima are -0.397887."""
    x, y = 15 * points[:, 0] - 5, 15 * points[:, 1]
    inner = y - 5.1 / (4 * np.pi**2) * x**2 + 5 / np.pi * x - 6
    return -(inner**2 + 10 * (1 - 1 / (8 * np.pi)) * np.cos(x) + 10)


def rastrigin(points: Array) -> Array:
    """Return Rastrigin's function with its sign changed; its maximum, 0, is at (0.3, ..., 0.3)."""
    moved = 4 * (points - 0.3)
    return np.asarray(-(moved**2 + 1 - np.cos(2 * np.pi * moved)).sum(axis=1))


@pytest.mark.parametrize(
    ("function", "dimension", "maximum", "error"),
    [
        (hartmann, 6, 3.32237, 1e-3),
        (branin, 2, -0.397887, 1e-4),
        (rastrigin, 1, 0.0, 1e-4),
        (rastrigin, 3, 0.0, 1e-2),
    ],
)
@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_it_finds_the_maxima_of_reference_functions(
    function: Values, dimension: int, maximum: float, error: float, seed: int
) -> None:
    assert search(function, dimension, seed, 9000).values[0] == pytest.approx(maximum, abs=error)


@pytest.mark.parametrize("dimension", [1, 2, 5, 20, *more(11)])
def test_it_finds_a_corner_exactly(dimension: int) -> None:
    corner = (np.arange(dimension) % 3 > 0).astype(float)
    found = search(lambda X: np.exp(-np.abs(X - corner).sum(axis=1)), dimension)
    np.testing.assert_array_equal(found.points[0], corner)


def test_it_finds_a_maximum_within_a_face() -> None:
    best = np.array([0.0, 1.0, 0.3, 0.6, 1.0])
    found = search(lambda X: -np.abs(X - best).sum(axis=1), 5)
    np.testing.assert_array_equal(found.points[0][[0, 1, 4]], best[[0, 1, 4]])
    np.testing.assert_allclose(found.points[0], best, atol=0.01)


def cliff(dimension: int, seed: int, share: float = 1.5e-4) -> Values:
    """Return a hill up to 0.5 and a cube with this share of the volume in which values are about 1.

    Around the small cube the values rise a little towards it.
    """
    rng = np.random.default_rng([seed, dimension])
    half = share ** (1 / dimension) / 2
    hill, centre = rng.uniform(0.2, 0.8, dimension), rng.uniform(half, 1 - half, dimension)

    def function(points: Array) -> Array:
        away = np.abs(points - centre).max(axis=1)
        low = 0.5 * np.exp(-2 * ((points - hill) ** 2).sum(axis=1)) + 0.2 * np.exp(-away / (3 * half))
        return np.where(away < half, 1 - 0.1 * away / half, low)

    return function


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("dimension", [3, *more(2, 4)])
def test_it_finds_rare_cliffs(dimension: int) -> None:
    found = [search(cliff(dimension, seed), dimension, seed, 9000).values[0] for seed in range(5)]
    assert sum(value >= 0.99 for value in found) >= 4


def test_the_elites_of_several_hills_are_on_all_of_them() -> None:
    hills = np.array([[0.2, 0.2, 0.2], [0.8, 0.8, 0.3], [0.2, 0.8, 0.7]])
    heights = np.array([1.0, 0.95, 0.9])

    def distances(X: Array) -> Array:
        return np.asarray(np.linalg.norm(X[:, None] - hills, axis=2))

    found = search(lambda X: (heights * np.exp(-((distances(X) / 0.15) ** 2))).max(axis=1), 3)
    assert (distances(found.local_maxima).min(axis=0) < 0.02).all()
    apart = np.linalg.norm(found.local_maxima[:, None] - found.local_maxima, axis=2)[
        np.triu_indices(len(found.local_maxima), 1)
    ]
    assert apart.min() > 0.1
    np.testing.assert_array_equal(found.local_maxima[0], found.points[0])


@pytest.mark.parametrize("dimension", [2, 5])
def test_what_is_not_finite_is_no_maximum(dimension: int) -> None:
    found = search(lambda X: np.where(X[:, 0] > 0.5, np.nan, X[:, 0]), dimension)
    assert 0.49 < found.points[0, 0] <= 0.5
    assert found.values[0] == found.points[0, 0]
    assert (found.local_maxima[:, 0] <= 0.5).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_without_any_finite_value_there_are_no_elites(value: float) -> None:
    found = search(lambda X: np.full(len(X), value), 3, evaluations=500)
    assert found.local_maxima.shape == (0, 3)
    assert (found.values == -np.inf).all()


def test_a_constant_function_is_searched_without_a_warning() -> None:
    assert search(lambda X: np.ones(len(X)), 4, evaluations=500).values[0] == 1.0


@given(st.integers(1, 12), st.integers(1, 700), st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_it_keeps_its_budget_and_stays_in_the_cube(dimension: int, evaluations: int, starts: int, seed: int) -> None:
    asked: list[Array] = []

    def function(X: Array) -> Array:
        asked.append(X)
        return np.asarray(X.sum(axis=1))

    rng = np.random.default_rng(seed)
    first = rng.random((starts, dimension))
    found = search_globally(function, dimension, first, rng, evaluations=evaluations)
    points = np.concatenate(asked)
    assert ((points >= 0) & (points <= 1)).all()
    assert len(points) == len(found.values) <= evaluations
    assert (np.diff(found.values) <= 0).all()
    np.testing.assert_array_equal(points[: min(starts, evaluations)], first[:evaluations])


def test_batches_are_few_and_no_larger_than_a_tenth() -> None:
    sizes: list[int] = []

    def function(X: Array) -> Array:
        sizes.append(len(X))
        return np.asarray(X.sum(axis=1))

    search(function, 4, evaluations=5000)
    assert max(sizes) <= 500
    assert len(sizes) < 120


def test_the_same_randomness_finds_the_same_points() -> None:
    first, again = (search(lambda X: np.sin(9 * X).prod(axis=1), 5, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.local_maxima, again.local_maxima)
    other = search(lambda X: np.sin(9 * X).prod(axis=1), 5, seed=4)
    assert not np.array_equal(first.points, other.points)
