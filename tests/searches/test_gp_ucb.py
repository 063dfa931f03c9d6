from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ctxval.errors import InputError
from ctxval.gp.acquisition import UpperConfidenceBound
from ctxval.gp.kernels import Matern
from ctxval.searches import GPUCB, Random, Search
from facts import refuses
from rig_thorough import more

Function = Callable[[np.ndarray], np.ndarray]


def ripple(X: np.ndarray) -> np.ndarray:
    """Return a function of 1-D points with two bumps, the higher, 1.0, at 0.75."""
    x = X[:, 0]
    return np.exp(-(((x - 0.75) / 0.1) ** 2)) + 0.7 * np.exp(-(((x - 0.25) / 0.12) ** 2))


def peak(X: np.ndarray) -> np.ndarray:
    """Return a function of 2-D points whose maximum, 1.0, is at (0.3, 0.8)."""
    return np.exp(-4 * (X[:, 0] - 0.3) ** 2 - 8 * (X[:, 1] - 0.8) ** 2)


def run(
    search: Search, function: Function, budget: int, dimension: int = 1, seed: int = 0, until: float = np.inf
) -> np.ndarray:
    """Return the values found, in their order, up to the first that exceeds ``until``."""
    search.reset(dimension, seed)
    values: list[float] = []
    while len(values) < budget and not (values and values[-1] > until):
        point = search.ask(1)
        values.append(float(function(point)[0]))
        search.tell(point, values[-1:])
    return np.array(values)


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_it_finds_the_higher_of_two_bumps(seed: int) -> None:
    assert run(GPUCB(), ripple, 20, 1, seed, until=0.99).max() > 0.99


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_it_finds_the_top_of_a_two_dimensional_hill(seed: int) -> None:
    assert run(GPUCB(), peak, 18, 2, seed, until=0.99).max() > 0.99


def test_it_finds_what_random_points_do_not() -> None:
    bayesian = [run(GPUCB(), peak, 15, 2, seed).max() for seed in range(2)]
    random = [run(Random(), peak, 15, 2, seed).max() for seed in range(2)]
    assert min(bayesian) > max(random)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_its_choices_do_not_depend_on_the_units_of_the_values(scale: float) -> None:
    search, scaled = GPUCB(), GPUCB()
    run(search, ripple, 9)
    run(scaled, lambda X: 5 * scale + scale * ripple(X), 9)
    np.testing.assert_allclose(scaled.points, search.points, atol=1e-3)


def test_the_first_points_are_the_random_draws_of_the_seed() -> None:
    search, random = GPUCB(initial=4), Random()
    search.reset(2, 5)
    random.reset(2, 5)
    np.testing.assert_array_equal(search.ask(4), random.ask(4))
    assert search.initial == 4


def test_without_two_known_values_it_goes_on_with_random_points() -> None:
    search, random = GPUCB(initial=2), Random()
    search.reset(2, 5)
    random.reset(2, 5)
    expected = random.ask(6)
    for i in range(6):
        point = search.ask(1)
        np.testing.assert_array_equal(point[0], expected[i])
        search.tell(point, [1.0 if i == 2 else np.nan])


def test_the_next_point_maximises_the_upper_confidence_bound() -> None:
    search = GPUCB(beta=3.0)
    run(search, peak, 8, 2)
    bound = UpperConfidenceBound(search.surrogate().process, 3.0)
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 101)] * 2), axis=-1).reshape(-1, 2)
    assert bound(search.ask(1))[0] >= bound(grid).max() - 1e-6


def test_a_larger_beta_goes_where_less_is_known_and_less_is_expected() -> None:
    points = np.random.default_rng(0).random((10, 2))
    means, deviations = [], []
    for beta in (0.1, 2.0, 100.0):
        search = GPUCB(beta)
        search.reset(2, 0)
        search.tell(points, peak(points))
        mean, deviation = search.surrogate().predict(search.ask(1))
        means.append(mean[0])
        deviations.append(deviation[0])
    assert (np.diff(means) < 0).all()
    assert (np.diff(deviations) > 0).all()


def test_a_search_that_has_converged_explores_the_largest_gap() -> None:
    search = GPUCB(beta=1e-8)
    search.reset(1, 0)
    search.tell([[0.0], [0.1], [0.2], [0.3], [1.0]], [0.0, 0.5, 1.0, 0.5, 0.0])
    search.tell([[0.2 + 1e-4]], [1.0])
    assert 0.4 < search.ask(1)[0, 0] < 0.9


def test_all_points_are_in_the_unit_cube_and_distinct() -> None:
    for function in (peak, lambda X: X.sum(axis=1), lambda X: np.zeros(len(X))):
        search = GPUCB()
        run(search, function, 14, 2, seed=3)
        assert ((search.points >= 0) & (search.points <= 1)).all()
        assert len(np.unique(search.points, axis=0)) == 14


# A function of seed and history


def with_failures(search: Search, budget: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Run a search of which every third evaluation fails."""
    search.reset(2, seed)
    points, values = [], []
    for i in range(budget):
        point = search.ask(1)
        points.append(point[0])
        values.append(np.nan if i % 3 == 1 else float(peak(point)[0]))
        search.tell(point, values[-1:])
    return np.array(points), np.array(values)


@pytest.mark.parametrize("told", [0, 1, 4, 7, 9])
def test_a_fresh_search_that_is_told_the_history_asks_the_same_points(told: int) -> None:
    points, values = with_failures(GPUCB(initial=3), 10)
    fresh = GPUCB(initial=3)
    fresh.reset(2, 0)
    if told:
        fresh.tell(points[:told], values[:told])
    np.testing.assert_array_equal(fresh.ask(1)[0], points[told])


def test_a_search_that_is_reset_repeats_itself() -> None:
    search = GPUCB(initial=3)
    first, _ = with_failures(search, 8)
    again, _ = with_failures(search, 8)
    np.testing.assert_array_equal(first, again)
    other, _ = with_failures(search, 8, seed=1)
    assert not np.isin(other, first).any()


def test_history_may_be_told_pending_first_and_known_later() -> None:
    points, values = with_failures(GPUCB(initial=3), 8)
    late = GPUCB(initial=3)
    late.reset(2, 0)
    late.tell(points[:7], np.full(7, np.nan))
    known = np.flatnonzero(~np.isnan(values[:7]))
    late.tell(points[known[::-1]], values[known[::-1]])
    np.testing.assert_array_equal(late.ask(1)[0], points[7])


def test_a_point_that_failed_is_never_asked_again() -> None:
    # The top of the hill cannot be evaluated: every success draws the search back to it.
    def peak_with_hole(X: np.ndarray) -> np.ndarray:
        return np.where(np.linalg.norm(X - [0.3, 0.8], axis=1) < 0.1, np.nan, peak(X))

    search = GPUCB(initial=4)
    values = run(search, peak_with_hole, 16, 2)
    failed, asked = search.points[np.isnan(values)], search.points
    assert len(failed) >= 2
    for point in failed:
        assert np.sum(np.abs(asked - point).max(axis=1) <= 1e-6) == 1


def test_pending_points_spread_a_batch_of_questions() -> None:
    search = GPUCB()
    run(search, peak, 6, 2)
    asked = search.ask(3)
    gaps = [np.linalg.norm(asked[i] - asked[j]) for i in range(3) for j in range(i)]
    assert min(gaps) > 1e-3


# The prior mean


def evaluations_until(search: Search, function: Function, value: float, seed: int) -> int:
    return len(run(search, function, 14, 2, seed, until=value))


def test_a_good_prior_mean_needs_fewer_evaluations() -> None:
    def guess(X: np.ndarray) -> np.ndarray:
        return 0.9 * peak(X - [0.02, -0.03]) + 0.05 * np.sin(9 * X[:, 0])

    plain = [evaluations_until(GPUCB(initial=2), peak, 0.99, seed) for seed in range(3)]
    informed = [evaluations_until(GPUCB(initial=2, prior_mean=guess), peak, 0.99, seed) for seed in range(3)]
    assert sum(informed) < 0.7 * sum(plain)


def test_an_exact_prior_mean_leads_straight_to_the_top() -> None:
    values = run(GPUCB(initial=2, prior_mean=peak), peak, 3, 2)
    assert values[2] > 1 - 1e-3


def test_a_wrong_prior_mean_does_not_keep_the_top_hidden() -> None:
    assert run(GPUCB(prior_mean=lambda X: 1 - peak(X)), peak, 25, 2, until=0.99).max() > 0.99


# Options


def test_the_surrogate_has_the_chosen_kernel_and_noise() -> None:
    search = GPUCB(kernel=Matern(2.5, ard=True), noise=(1e-3, 1e-3))
    run(search, peak, 5, 2)
    process = search.surrogate().process
    assert process.kernel == Matern(2.5, ard=True)
    assert process.noise == pytest.approx(1e-3)
    assert GPUCB().kernel == Matern(1.5)


@pytest.mark.parametrize("beta", [-1.0, np.nan])
def test_a_beta_that_is_negative_is_refused_by_value(beta: float) -> None:
    with refuses(InputError, "beta", 0, beta):
        GPUCB(beta)


def test_a_search_without_initial_points_is_refused() -> None:
    with refuses(InputError, "initial", 0):
        GPUCB(initial=0)


def test_the_surrogate_of_too_short_a_history_is_refused() -> None:
    search = GPUCB()
    search.reset(1, 0)
    search.tell([[0.5]], [1.0])
    with refuses(InputError, 1, "surrogate"):
        search.surrogate()
