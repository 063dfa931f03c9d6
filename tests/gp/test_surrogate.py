from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from ctxval import searches
from ctxval._util.arrays import Array
from ctxval.errors import InputError
from ctxval.gp import regression
from ctxval.gp.cholesky import pivoted_cholesky, pivoted_matrix, pivoted_rows
from ctxval.gp.kernels import Matern
from ctxval.gp.surrogate import SurrogateHyperparameters, fit_surrogate, kept_rows, learn
from facts import refuses
from rig_thorough import more


def data(n: int = 15, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    X = np.random.default_rng(seed).random((n, 2))
    return X, np.sin(5 * X[:, 0]) + X[:, 1]


def where() -> np.ndarray:
    return np.random.default_rng(99).random((30, 2))


@settings(max_examples=10)
@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3))
def test_predictions_are_in_the_units_of_the_values(shift: float, scale: float) -> None:
    X, y = data()
    mean, deviation = fit_surrogate(X, y).predict(where())
    moved, widened = fit_surrogate(X, shift + scale * y).predict(where())
    np.testing.assert_allclose(moved, shift + scale * mean, rtol=0, atol=1e-3 * scale + 1e-9 * abs(shift))
    np.testing.assert_allclose(widened, scale * deviation, rtol=1e-2, atol=1e-3 * scale)


def test_the_surrogate_goes_through_noise_free_values() -> None:
    X, y = data()
    mean, deviation = fit_surrogate(X, y).predict(X)
    np.testing.assert_allclose(mean, y, atol=1e-3)
    assert deviation.max() < 0.01


def test_the_surrogate_is_close_to_the_function_between_many_values() -> None:
    X, y = data(60)
    mean, deviation = fit_surrogate(X, y, Matern(2.5, ard=True)).predict(where())
    truth = np.sin(5 * where()[:, 0]) + where()[:, 1]
    np.testing.assert_allclose(mean, truth, atol=0.05)
    assert (np.abs(mean - truth) <= 4 * deviation + 1e-3).all()


def test_the_given_kernel_and_noise_are_used() -> None:
    X, y = data()
    surrogate = fit_surrogate(X, y, Matern(2.5, ard=True), noise=(0.3, 0.3))
    assert surrogate.process.kernel == Matern(2.5, ard=True)
    assert surrogate.process.noise == pytest.approx(0.3)


def test_points_of_unknown_value_narrow_the_surrogate_and_move_nothing() -> None:
    X, y = data()
    pending = np.array([[0.95, 0.05], [0.05, 0.95]])
    alone = fit_surrogate(X, y)
    with_pending = fit_surrogate(np.concatenate([X, pending]), np.append(y, [np.nan, np.nan]))
    np.testing.assert_allclose(with_pending.predict(where())[0], alone.predict(where())[0], atol=1e-6)
    assert (with_pending.predict(where())[1] <= alone.predict(where())[1] + 1e-9).all()
    assert (with_pending.predict(pending)[1] < 0.1 * alone.predict(pending)[1]).all()


def test_equal_values_make_a_flat_surrogate_in_their_own_units() -> None:
    X, _ = data()
    mean, deviation = fit_surrogate(X, np.full(15, 7.0)).predict(where())
    np.testing.assert_allclose(mean, 7.0, rtol=1e-12)
    assert np.isfinite(deviation).all()


def test_an_exact_prior_mean_is_predicted_everywhere() -> None:
    X, y = data(4)
    prior = lambda X: np.sin(5 * X[:, 0]) + X[:, 1]  # noqa: E731
    np.testing.assert_allclose(fit_surrogate(X, y, prior_mean=prior).predict(where())[0], prior(where()), atol=1e-12)


@settings(max_examples=10)
@given(st.floats(1e-2, 1e2))
def test_a_prior_mean_is_in_the_units_of_the_values(scale: float) -> None:
    X, y = data()
    prior = lambda X: X[:, 1]  # noqa: E731
    mean, deviation = fit_surrogate(X, y, prior_mean=prior).predict(where())
    scaled, widened = fit_surrogate(X, scale * y, prior_mean=lambda X: scale * prior(X)).predict(where())
    np.testing.assert_allclose(scaled, scale * mean, rtol=0, atol=1e-3 * scale)
    np.testing.assert_allclose(widened, scale * deviation, rtol=1e-2, atol=1e-3 * scale)


@pytest.mark.parametrize("known", [0, 1])
def test_fewer_than_two_known_values_are_refused(known: int) -> None:
    X, y = data(3)
    y[known:] = np.nan
    with refuses(InputError, "surrogate", known):
        fit_surrogate(X, y)


@pytest.mark.parametrize("prior", [lambda X: np.full(len(X), np.nan), lambda X: X, lambda X: 0.0])
def test_a_prior_mean_without_one_finite_value_a_point_is_refused(prior: regression.Mean) -> None:
    with refuses(InputError, "mean"):
        fit_surrogate(*data(), prior_mean=prior)


# Learned once, conditioned often


def many(d: int = 6, n: int = 40, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((n, d))


def test_what_matters_gets_the_shorter_length_scales() -> None:
    X = many()
    learned = learn(X, np.sin(6 * X[:, 2]) + 0.01 * X[:, 4])
    scales = learned.theta[1:7]
    assert scales.argmin() == 2
    assert scales[2] < np.delete(scales, 2).min() - 0.3


def test_a_heavy_tail_is_a_process_of_the_logarithm_and_a_plain_function_is_not() -> None:
    X = many(3)
    steep = np.exp(6 * np.sin(2 * X).sum(axis=1))
    assert np.isfinite(learn(X, steep).warp.offset)
    assert np.isinf(learn(X, X.sum(axis=1)).warp.offset)
    assert np.isinf(learn(X, steep - steep.max()).warp.offset)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_what_is_learned_does_not_depend_on_the_units(scale: float) -> None:
    X = many(3)
    y = 1 + np.sin(4 * X).sum(axis=1) ** 2
    np.testing.assert_allclose(learn(X, scale * y).theta, learn(X, y).theta, atol=1e-3)


def test_the_process_goes_through_known_values_and_believes_what_it_predicts_elsewhere() -> None:
    X = many(2, 12)
    y = np.sin(5 * X).sum(axis=1)
    learned = learn(X[:8], y[:8])
    values = np.where(np.arange(12) % 4 == 3, np.nan, y)
    process = learned.condition(X, values)
    np.testing.assert_allclose(process.predict(X)[0][::4], learned.standardised(y)[::4], atol=1e-3)
    alone = learned.condition(X[np.isfinite(values)], values[np.isfinite(values)])
    np.testing.assert_allclose(process.predict(where())[0], alone.predict(where())[0], atol=1e-5)
    assert (process.predict(X)[1] < 1e-3).all()


@pytest.mark.parametrize("values", [np.zeros(5), np.full(5, 3.0), np.array([0.0, 0.0, 0.0, 0.0, 1.0])])
def test_values_that_say_nothing_are_learned_from_without_harm(values: np.ndarray) -> None:
    learned = learn(many(2, 5), values)
    assert isinstance(learned, SurrogateHyperparameters)
    assert np.isfinite(learned.condition(many(2, 5), values).predict(where())[0]).all()


def test_the_prior_of_the_hyperparameters_has_the_gradient_that_differences_show() -> None:
    from ctxval.gp.surrogate import _prior

    (_, prior), at = _prior(4), np.random.default_rng(0).normal(size=8)
    numeric = [(prior(at + 1e-6 * e)[0] - prior(at - 1e-6 * e)[0]) / 2e-6 for e in np.eye(8)]
    np.testing.assert_allclose(prior(at)[1], numeric, rtol=1e-6, atol=1e-6)


def test_of_very_many_values_the_largest_and_a_spread_of_the_others_are_learned_from() -> None:
    X = many(2, 700)
    y = np.sin(4 * X).sum(axis=1)
    learned = learn(X, y)
    np.testing.assert_allclose(
        learned.condition(X, y).predict(where())[0],
        learned.standardised(np.sin(4 * where()).sum(axis=1)),
        atol=0.05,
    )


# What is kept of a long history: everything that a search needs of it, and few enough


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
    points, values = long_history(999, failed=100)
    np.testing.assert_array_equal(kept_rows(points, values, 10), np.arange(999))


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
    points, values = np.full((1000, 3), 0.5), np.zeros(1000)
    assert len(np.unique(kept_rows(points, values, 900))) == 900


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "dimension"),
    [("gp-ucb", 2), *more(("bayesian-optimisation", 6), ("bayesian-optimisation", 20), *UNCUT)],
)
def test_a_search_goes_on_over_a_long_history_as_one_never_stopped(name: str, dimension: int) -> None:
    points, values = long_history(1003, dimension, failed=50)

    def asked() -> Array:
        search = searches.by_name(name)
        search.reset(dimension, 4)
        search.tell(points[:998], values[:998])
        search.tell(points[998:], values[998:])
        proposed = search.ask(2)
        assert ((proposed >= 0) & (proposed <= 1)).all()
        assert cdist(proposed, points).min() > 1e-6
        return proposed

    np.testing.assert_array_equal(asked(), asked())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gp-ucb", *more("bayesian-optimisation")])
def test_a_long_history_leads_to_the_maximum_too(name: str) -> None:
    rng = np.random.default_rng(1)
    points = rng.random((1100, 2)) * [0.6, 1.0]  # the peak is where none of them is
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
    rows, L, remaining = pivoted_cholesky(np.diag(matrix), lambda row: matrix[row].copy(), count, least=1e-9)
    assert len(rows) == min(count, rank)
    chosen = matrix[np.ix_(rows, rows)]
    np.testing.assert_allclose(L @ L.T, chosen, atol=1e-8)
    np.testing.assert_array_equal(np.triu(L, 1), 0.0)
    others = matrix[rows]
    left = matrix - others.T @ np.linalg.pinv(chosen, rcond=1e-12) @ others if count else matrix
    np.testing.assert_allclose(remaining, np.maximum(np.diag(left), 0.0), atol=1e-5 * np.trace(matrix))
    of_whole = pivoted_matrix(np.diag(matrix), matrix, count, least=1e-9)
    np.testing.assert_array_equal(of_whole[0], rows)
    np.testing.assert_allclose(of_whole[1], L, atol=1e-6)
    np.testing.assert_allclose(of_whole[2], remaining, atol=1e-6)
