from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from ctxval.gp import regression
from ctxval.gp.acquisition import LogExpectedImprovement, Uncertainty, UpperConfidenceBound, log_improvement, maximise
from ctxval.gp.kernels import Matern


def process(n: int = 12, noise: float = 1e-4, prior: bool = False) -> regression.GaussianProcess:
    X = np.random.default_rng(0).random((n, 2))
    kernel, theta = Matern(2.5, ard=True, linear=(1e-4, 50.0)), np.log([1.0, 0.3, 0.5, 0.2, 0.4])
    mean = (lambda X: X[:, 0] * X[:, 1]) if prior else regression.zero_mean
    return regression.condition(kernel, theta, X, np.sin(5 * X).sum(axis=1), noise=noise, mean=mean)


@dataclass(frozen=True)
class Hill:
    """A quadratic hill with its top at ``top``."""

    top: tuple[float, ...]

    def __call__(self, X: np.ndarray) -> np.ndarray:
        return -((X - np.array(self.top)) ** 2).sum(axis=1)

    def with_gradient(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self(X), -2 * (X - np.array(self.top))


@pytest.mark.parametrize("beta", [0.0, 0.5, 2.0, 9.0])
def test_the_upper_confidence_bound_is_equation_11(beta: float) -> None:
    X = np.random.default_rng(1).random((9, 2))
    mean, variance = process().predict(X)
    np.testing.assert_allclose(UpperConfidenceBound(process(), beta)(X), mean + beta**0.5 * variance**0.5, rtol=1e-12)


def test_the_uncertainty_is_the_posterior_variance() -> None:
    X = np.random.default_rng(1).random((9, 2))
    np.testing.assert_array_equal(Uncertainty(process())(X), process().predict(X)[1])


@pytest.mark.parametrize("prior", [False, True])
@pytest.mark.parametrize(
    "make",
    [
        lambda p: UpperConfidenceBound(p, 2.0),
        Uncertainty,
        *(lambda p, best=best: LogExpectedImprovement(p, best) for best in (-1.0, 2.0, 10.0)),
    ],
)
def test_gradients_agree_with_finite_differences(make: type, prior: bool) -> None:
    acquisition, h = make(process(prior=prior)), 1e-6
    X = np.random.default_rng(2).random((9, 2))
    numeric = np.stack([(acquisition(X + h * e) - acquisition(X - h * e)) / (2 * h) for e in np.eye(2)], axis=-1)
    values, gradients = acquisition.with_gradient(X)
    np.testing.assert_allclose(gradients, numeric, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(values, acquisition(X), rtol=1e-9)


@pytest.mark.parametrize("best", [-0.5, 0.9, 1.5])
def test_the_expected_improvement_is_its_integral(best: float) -> None:
    X = np.random.default_rng(1).random((4, 2))
    mean, variance = process().predict(X)
    integrals = [
        quad(lambda f, m=m, s=s: (f - best) * norm.pdf(f, m, s), best, max(m, best) + 12 * s, epsabs=0)[0]
        for m, s in zip(mean, np.sqrt(variance), strict=True)
    ]
    np.testing.assert_allclose(LogExpectedImprovement(process(), best)(X), np.log(integrals), rtol=1e-6)


def test_the_logarithm_of_an_improvement_is_the_formula_where_floats_can_hold_it() -> None:
    z = np.linspace(-5, 8, 53)
    np.testing.assert_allclose(log_improvement(z), np.log(norm.pdf(z) + z * norm.cdf(z)), rtol=1e-9, atol=1e-12)


def test_the_logarithm_of_an_improvement_is_smooth_from_series_to_formula() -> None:
    # phi(z) / z^2 (1 - 3 / z^2 + 15 / z^4) is the leading part far below zero.
    for z in (-30.0, -300.0, -999.0, -1001.0, -1e6, -1e12):
        leading = norm.logpdf(z) - 2 * np.log(-z) + np.log1p(-3 / z**2 + 15 / z**4)
        assert log_improvement(np.array(z)) == pytest.approx(leading, abs=1e-6, rel=1e-14)
    for edge in (-1.0, -1000.0):
        below, above = log_improvement(edge + np.array([-1e-9, 1e-9]))
        assert 0 < above - below < 1e-5


def test_an_improvement_that_cannot_be_told_from_none_still_has_a_slope() -> None:
    certain = process(noise=1e-12)
    value, gradient = LogExpectedImprovement(certain, 1e4).with_gradient(certain.X + 1e-3)
    assert np.isfinite(value).all()
    assert np.isfinite(gradient).all()
    assert (np.abs(gradient).max(axis=1) > 0).all()


def test_where_nothing_is_uncertain_the_gradient_is_that_of_the_mean() -> None:
    # Without noise, the variance vanishes exactly at an observation.
    X = np.array([[0.5, 0.5]])
    certain = regression.condition(Matern(), np.log([1.0, 1.0]), X, np.array([1.0]), noise=0.0)
    assert certain.predict_with_gradient(X)[1][0] == 0
    bound = UpperConfidenceBound(certain, 2.0)
    np.testing.assert_array_equal(bound.with_gradient(X)[1], certain.predict_with_gradient(X)[2:][0])


@pytest.mark.parametrize("top", [(0.3,), (0.3, 0.8), (0.0, 1.0), (-0.5, 0.4), (0.2, 1.7, 0.6)])
def test_the_maximiser_of_a_hill_is_the_nearest_point_of_the_cube(top: tuple[float, ...]) -> None:
    none = np.empty((0, len(top)))
    found = maximise(Hill(top), len(top), none, np.random.default_rng(0))
    np.testing.assert_allclose(found, np.clip(top, 0, 1), atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("make", [lambda p: UpperConfidenceBound(p, 2.0), Uncertainty])
def test_the_maximiser_is_as_good_as_a_dense_grid(make: type, seed: int) -> None:
    acquisition = make(process())
    found = maximise(acquisition, 2, acquisition.process.X, np.random.default_rng(seed))
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 201)] * 2), axis=-1).reshape(-1, 2)
    assert ((found >= 0) & (found <= 1)).all()
    assert acquisition(found[None])[0] >= acquisition(grid).max() - 1e-6


def test_a_known_point_is_never_proposed_even_where_it_is_the_best() -> None:
    known = np.array([[0.0, 1.0], [0.4, 0.4]])
    for top in ((-1.0, 2.0), (0.4, 0.4)):
        for seed in range(5):
            found = maximise(Hill(top), 2, known, np.random.default_rng(seed))
            assert np.abs(found - known).max(axis=1).min() > 1e-6
            assert np.linalg.norm(found - np.clip(top, 0, 1)) < 0.2


def test_the_maximiser_stays_away_from_known_points_if_anything_else_is_a_candidate() -> None:
    known = np.array([[0.4, 0.4], [0.42, 0.4]])
    found = maximise(Hill((0.4, 0.4)), 2, known, np.random.default_rng(0), near=0.05)
    assert 0.05 < np.abs(found - known).max(axis=1).min() < 0.1
    crowded = np.linspace(0, 1, 21)[:, None]
    found = maximise(Hill((0.41,)), 1, crowded, np.random.default_rng(0), near=0.05)
    np.testing.assert_allclose(found, 0.41, atol=1e-4)


def test_the_maximiser_is_a_function_of_its_generator() -> None:
    bound = UpperConfidenceBound(process())
    first, again = (maximise(bound, 2, bound.process.X, np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(first, again)


def test_a_flat_acquisition_still_gives_a_new_point_of_the_cube() -> None:
    @dataclass
    class Flat:
        def __call__(self, X: np.ndarray) -> np.ndarray:
            return np.zeros(len(X))

        def with_gradient(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return self(X), np.zeros_like(X)

    known = np.random.default_rng(0).random((20, 2))
    found = maximise(Flat(), 2, known, np.random.default_rng(1))
    assert ((found >= 0) & (found <= 1)).all()
    assert np.abs(found - known).max(axis=1).min() > 1e-6


def test_the_maximiser_stays_in_its_box() -> None:
    box = (np.array([0.0, 0.5]), np.array([0.5, 1.0]))
    for corners in (False, True):
        found = maximise(Hill((0.7, 0.8)), 2, np.empty((0, 2)), np.random.default_rng(0), box=box, corners=corners)
        np.testing.assert_allclose(found, [0.5, 0.8], atol=1e-4)


def test_pending_and_failed_points_are_kept_away_from() -> None:
    away = np.array([[0.7, 0.8]])
    found = maximise(Hill((0.7, 0.8)), 2, away, np.random.default_rng(0), away=away)
    assert 0.02 * np.sqrt(2) < np.linalg.norm(found - away[0]) < 0.1


def test_moves_of_single_coordinates_to_bounds_find_a_corner_that_climbs_miss() -> None:
    @dataclass(frozen=True)
    class Corners:
        """Slopes away from the middle on every axis: each corner is a local maximum, and 1, 1, ... is the best."""

        def __call__(self, X: np.ndarray) -> np.ndarray:
            return (np.abs(X - 0.5) + 0.1 * X).sum(axis=1)

        def with_gradient(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return self(X), np.sign(X - 0.5) + 0.1

    rng = np.random.default_rng
    plain = maximise(Corners(), 20, np.empty((0, 20)), rng(0))
    polished = maximise(Corners(), 20, np.empty((0, 20)), rng(0), corners=True)
    np.testing.assert_array_equal(polished, 1.0)
    assert (plain < 0.5).any()
