from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from ctxval import gp
from ctxval.acquisition import Uncertainty, UpperConfidenceBound, maximise
from ctxval.kernels import Linear, Matern, Sum


def process(n: int = 12, noise: float = 1e-4, prior: bool = False) -> gp.GaussianProcess:
    X = np.random.default_rng(0).random((n, 2))
    kernel, theta = Sum(Matern(2.5, ard=True), Linear()), np.log([1.0, 0.3, 0.5, 0.2, 0.4])
    mean = (lambda X: X[:, 0] * X[:, 1]) if prior else gp.zero_mean
    return gp.condition(kernel, theta, X, np.sin(5 * X).sum(axis=1), noise=noise, mean=mean)


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
@pytest.mark.parametrize("make", [lambda p: UpperConfidenceBound(p, 2.0), Uncertainty])
def test_gradients_agree_with_finite_differences(make: type, prior: bool) -> None:
    acquisition, h = make(process(prior=prior)), 1e-6
    X = np.random.default_rng(2).random((9, 2))
    numeric = np.stack([(acquisition(X + h * e) - acquisition(X - h * e)) / (2 * h) for e in np.eye(2)], axis=-1)
    values, gradients = acquisition.with_gradient(X)
    np.testing.assert_allclose(gradients, numeric, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(values, acquisition(X), rtol=1e-9)


def test_where_nothing_is_uncertain_the_gradient_is_that_of_the_mean() -> None:
    # One observation of a linear function through it: without noise the variance vanishes there exactly.
    X = np.array([[0.5, 0.5]])
    certain = gp.condition(Linear(), np.log([1.0, 1.0]), X, np.array([1.0]), noise=0.0)
    assert certain.predict_with_gradient(X)[1][0] == 0
    bound = UpperConfidenceBound(certain, 2.0)
    np.testing.assert_array_equal(bound.with_gradient(X)[1], certain.predict_gradient(X)[0])


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
