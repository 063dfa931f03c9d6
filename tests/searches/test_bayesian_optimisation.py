from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.errors import InputError
from ctxval.searches import BayesianOptimisation, Random, Search, by_name
from ctxval.testing import check_search
from facts import refuses
from rig_thorough import more

Function = Callable[[Array], Array]


SEEDS = [0, *more(1, 2)]


def peak(X: Array) -> Array:
    """Return a function whose maximum, 1.0, is at (0.3, 0.8, ...)."""
    return np.exp(-4 * ((X - np.resize([0.3, 0.8], X.shape[1])) ** 2).sum(axis=1))


def fold(X: Array) -> Array:
    """Return the norm of a linear function; its largest value is at a corner, and other corners are local maxima."""
    C = np.random.default_rng(7).normal(size=(3, X.shape[1]))
    return np.abs((X - 0.5) @ C.T).sum(axis=1)


def trap(X: Array) -> Array:
    """Return a wide hill of height 0.6 where x_0 = 0, and a narrower one of height 1 where x_0 = 1."""
    wide = 0.6 * np.exp(-2 * ((X - 0.0) ** 2).sum(axis=1) / X.shape[1])
    return np.maximum(wide, np.exp(-5 * (1 - X[:, 0]) ** 2 - 2 * ((X[:, 1:] - 0.7) ** 2).sum(axis=1)))


def corner(X: Array) -> float:
    """Return the largest value of a convex function, which is at a corner."""
    d = X.shape[1]
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * d, indexing="ij"), axis=-1).reshape(-1, d)
    return float(fold(corners).max())


def run(search: Search, function: Function, budget: int, dimension: int = 2, seed: int = 0) -> Array:
    search.reset(dimension, seed)
    values: list[float] = []
    for _ in range(budget):
        point = search.ask(1)
        values.append(float(function(point)[0]))
        search.tell(point, values[-1:])
    return np.array(values)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("dimension", "budget"), [*more((1, 12)), (2, 20), *more((6, 40))])
def test_it_finds_the_top_of_a_hill(dimension: int, budget: int, seed: int) -> None:
    assert run(BayesianOptimisation(), peak, budget, dimension, seed).max() > 0.98


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("seed", SEEDS)
def test_it_finds_the_highest_corner_of_a_folded_plane(seed: int) -> None:
    values = run(BayesianOptimisation(), fold, 40, 8, seed)
    assert values.max() > 0.98 * corner(np.empty((0, 8)))
    assert values.max() > run(Random(), fold, 400, 8, seed).max()


@pytest.mark.thorough
def test_it_leaves_a_wide_basin_for_a_higher_one_that_is_hidden() -> None:
    found = [run(BayesianOptimisation(), trap, 40, 3, seed).max() for seed in range(2)]
    assert min(found) > 0.7
    assert np.median(found) > 0.9


def test_a_search_that_stagnates_branches_across_the_coordinate_that_it_has_crossed_least() -> None:
    search = BayesianOptimisation()
    run(search, lambda X: 1 - X[:, 0] + 0.01 * X[:, 1], 30, 3)
    branches = [note["branch"] for note in search.notes if note is not None and note.get("branch") is not None]
    assert branches[0] == [0, True]
    assert len({tuple(branch) for branch in branches}) > 1
    for note, point in zip(search.notes, search.points, strict=True):
        if note is not None and note.get("branch") is not None:
            coordinate, upper = note["branch"]
            assert (point[coordinate] >= 0.5) == upper or point[coordinate] == 0.5


def test_acquisition_functions_take_turns() -> None:
    search = BayesianOptimisation()
    run(search, peak, 12, 4)
    hows = [note["how"] for note in search.notes if note is not None]
    assert hows[:3] == ["initial"] * 3
    assert hows[3:] == ["improvement", "improvement", "bound"] * 3


@pytest.mark.parametrize("dimension", [1, 2])
def test_in_few_dimensions_a_share_of_the_points_fills_the_space(dimension: int) -> None:
    search = BayesianOptimisation()
    run(search, lambda X: -((X - 0.5) ** 2).sum(axis=1), 24, dimension)
    assert sum(note is not None and note["how"] == "filling" for note in search.notes) == 5
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 41)] * dimension), axis=-1).reshape(-1, dimension)
    gaps = np.linalg.norm(grid[:, None] - search.points[None], axis=2).min(axis=1)
    assert gaps.max() < (0.15 if dimension == 1 else 0.45)


def test_its_choices_do_not_depend_on_the_units_of_the_values() -> None:
    search, scaled = BayesianOptimisation(), BayesianOptimisation()
    run(search, peak, 9)
    run(scaled, lambda X: 1e3 * peak(X), 9)
    np.testing.assert_allclose(scaled.points, search.points, atol=1e-3)


def test_values_that_are_all_the_same_and_negative_ones_do_no_harm() -> None:
    for function in (lambda X: np.zeros(len(X)), lambda X: -peak(X)):
        search = BayesianOptimisation()
        run(search, function, 16, 3)
        assert len(np.unique(search.points, axis=0)) == 16
        assert ((search.points >= 0) & (search.points <= 1)).all()


# Batches and failures


@pytest.mark.parametrize("dimension", [1, 20, *more(2)])
@pytest.mark.parametrize("told", [0, 20])
def test_a_batch_of_questions_is_diverse(told: int, dimension: int) -> None:
    search = BayesianOptimisation()
    if told:
        run(search, peak, told, dimension)
    else:
        search.reset(dimension, 0)
    asked = search.ask(6)
    gaps = [np.linalg.norm(asked[i] - asked[j]) for i in range(6) for j in range(i)]
    assert min(gaps) > 0.01 * np.sqrt(dimension)
    for earlier in search.points[:told]:
        assert np.abs(asked - earlier).max(axis=1).min() > 1e-6


def test_batches_find_the_top_in_hardly_more_executions() -> None:
    search = BayesianOptimisation()
    search.reset(2, 0)
    best = -np.inf
    for _ in range(8):
        points = search.ask(4)
        values = peak(points)
        search.tell(points[::-1], values[::-1])
        best = max(best, float(values.max()))
    assert best > 0.98


def test_what_failed_is_not_asked_again_and_does_not_stop_the_search() -> None:
    def holed(X: Array) -> Array:
        return np.where(np.linalg.norm(X - [0.3, 0.8], axis=1) < 0.1, np.nan, peak(X))

    search = BayesianOptimisation()
    values = run(search, holed, 24)
    assert np.nanmax(values) > 0.93
    gaps = np.abs(search.points[:, None] - search.points[None]).max(axis=2) + np.eye(24)
    assert gaps.min() > 1e-6
    assert np.isnan(values).sum() < 12


# A function of seed and history


@pytest.mark.slow
@pytest.mark.thorough
def test_it_keeps_the_contract_of_a_search() -> None:
    check_search(BayesianOptimisation(initial=1), dimension=5, budget=12)
    assert type(by_name("bayesian-optimisation", beta=1.0)) is BayesianOptimisation


@pytest.mark.slow
@pytest.mark.parametrize("told", [21, *more(1, 30, 43)])
def test_told_its_history_late_and_in_another_order_it_asks_for_the_same_point(told: int) -> None:
    whole = BayesianOptimisation()
    values = run(whole, fold, told + 1, 5)
    fresh = BayesianOptimisation()
    fresh.reset(5, 0)
    fresh.tell(whole.points[:told], np.full(told, np.nan))
    fresh.ask(1)  # whatever it learns from half of the history must not stay
    for k in reversed(range(told)):
        fresh.tell(whole.points[k : k + 1], values[k : k + 1])
    again = BayesianOptimisation()
    again.reset(5, 0)
    again.tell(whole.points[:told], values[:told])
    np.testing.assert_array_equal(again.ask(1)[0], whole.points[told])
    np.testing.assert_array_equal(fresh.points[:told], again.points[:told])
    again.tell(fresh.points[told:], [np.nan])
    assert fresh.ask(1).shape == (1, 5)


@pytest.mark.thorough
def test_a_suggestion_after_a_thousand_values_takes_seconds_at_most() -> None:
    search = BayesianOptimisation()
    search.reset(20, 0)
    X = np.random.default_rng(0).random((1000, 20))
    search.tell(X, fold(X))
    started = time.process_time()
    search.ask(1)
    assert time.process_time() - started < 20  # about 1 s on one core; far more only if it were to grow with n^4


@pytest.mark.parametrize(
    ("options", "facts"),
    [({"beta": -1.0}, (0, "beta")), ({"initial": 0}, (0, "initial"))],
)
def test_options_that_cannot_be_are_refused_by_value(options: dict[str, float], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        BayesianOptimisation(**options)  # type: ignore[arg-type]
