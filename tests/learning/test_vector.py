from __future__ import annotations

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.errors import ShapeError
from ctxval.learning.prediction import _log_likelihood, predict_composed
from ctxval.searches import TrustRegion

C = np.random.default_rng(3).normal(size=(4, 8))


def linear(X: Array) -> Array:
    return (X - 0.4) @ C.T


def bent(X: Array) -> Array:
    return linear(X) + 0.3 * np.sin(4 * X[:, :1])


def norm(vectors: Array) -> Array:
    return np.abs(vectors).sum(axis=-1)


def points(n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random((n, 8))


def test_a_linear_vector_is_known_from_little_more_points_than_there_are_dimensions() -> None:
    prediction = predict_composed(points(12), linear(points(12)), norm)
    assert prediction is not None
    expected, doubt = prediction.expected(points(50, 1))
    np.testing.assert_allclose(expected, norm(linear(points(50, 1))), rtol=0.05)
    assert doubt.max() < 0.2


def test_doubt_is_nothing_at_known_points_and_large_where_little_is_known() -> None:
    X = points(6)
    prediction = predict_composed(X, bent(X), norm)
    assert prediction is not None
    expected, doubt = prediction.expected(X)
    np.testing.assert_allclose(expected, norm(bent(X)), rtol=1e-3)
    assert doubt.max() < 1e-2
    assert prediction.expected(points(20, 1))[1].min() > 0.02


def test_a_point_left_out_is_predicted_from_the_others_with_the_same_hyperparameters() -> None:
    X = points(30)
    whole, without = predict_composed(X, bent(X), norm), predict_composed(X[:-1], bent(X[:-1]), norm)
    assert whole is not None
    assert without is not None
    assert whole.left_out(np.array([29]))[0] == pytest.approx(without.expected(X[-1:])[0][0], rel=0.02)
    assert whole.left_out(np.array([4, 7])).shape == (2,)


def test_the_units_do_not_matter() -> None:
    X = points(12)
    metres, millimetres = predict_composed(X, bent(X), norm), predict_composed(X, 1e3 * bent(X), norm)
    assert metres is not None
    assert millimetres is not None
    expected, doubt = metres.expected(points(5, 1))
    np.testing.assert_allclose(millimetres.expected(points(5, 1))[0], 1e3 * expected, rtol=1e-3)
    np.testing.assert_allclose(millimetres.expected(points(5, 1))[1], doubt, rtol=1e-3)


def test_it_is_a_plain_function_whatever_points_are_asked_about_together() -> None:
    prediction = predict_composed(points(6), bent(points(6)), norm)
    assert prediction is not None
    together = prediction.expected(points(4, 1))
    alone = [prediction.expected(point[None]) for point in points(4, 1)]
    np.testing.assert_allclose(together[0], [value[0] for value, _ in alone], rtol=1e-9)
    np.testing.assert_allclose(together[1], [doubt[0] for _, doubt in alone], rtol=1e-6)


def test_points_that_repeat_themselves_do_no_harm() -> None:
    X = np.repeat(points(5), 3, axis=0)
    prediction = predict_composed(X, linear(X), norm)
    assert prediction is not None
    assert np.isfinite(prediction.expected(points(5, 1))[0]).all()


def test_nothing_is_expected_of_one_vector_or_of_vectors_that_vanish() -> None:
    assert predict_composed(points(1), linear(points(1)), norm) is None
    assert predict_composed(points(5), np.zeros((5, 2)), norm) is None


def test_points_and_vectors_that_do_not_fit_are_refused_with_both_shapes() -> None:
    with pytest.raises(ShapeError, match=r"\(5, 8\), \(4, 4\)"):
        predict_composed(points(5), linear(points(4)), norm)


def test_the_gradient_of_the_likelihood_agrees_with_finite_differences() -> None:
    X, theta = points(12), np.random.default_rng(0).normal(-1, 0.3, size=11)
    _, gradient = _log_likelihood(theta, X, bent(X))
    numeric = [
        (_log_likelihood(theta + 1e-6 * e, X, bent(X))[0] - _log_likelihood(theta - 1e-6 * e, X, bent(X))[0]) / 2e-6
        for e in np.eye(11)
    ]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_climbs_on_it_find_the_largest_norm_soon(seed: int) -> None:
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 8, indexing="ij"), axis=-1).reshape(-1, 8)
    search = TrustRegion()
    search.reset(8, seed)
    for _ in range(14):
        search.use_prediction(predict_composed(search.points, linear(search.points), norm))
        point = search.ask(1)
        search.tell(point, norm(linear(point)))
    assert search.values.max() > 0.99 * norm(linear(corners)).max()
