from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array
from ctxval.learning.hyperparameters import ResidualKernel

FAMILIES = [(nu, growth, inputs) for nu in (1.5, 2.5, 4.5) for growth in (0.0, 1.0, 0.3) for inputs in (1, 2)]
every_family = pytest.mark.parametrize(("nu", "growth", "inputs"), FAMILIES)
families = st.sampled_from(FAMILIES)
seeds = st.integers(0, 2**32 - 1)


def theta_of(kernel: ResidualKernel, dimension: int, rng: np.random.Generator) -> Array:
    low, high = np.array(kernel.bounds(dimension)).T
    return np.asarray(low + rng.random(len(low)) * (high - low))


def direct(kernel: ResidualKernel, theta: Array, X: Array, Z: Array) -> Array:
    """Return the covariances as the class states them."""
    scales, (constant, slope) = np.exp(theta[:-2]), np.exp(theta[-2:])
    s = np.sqrt(2 * kernel.nu) * cdist(X / scales, Z / scales)
    polynomials = {1.5: 1 + s, 2.5: 1 + s + s**2 / 3, 4.5: 1 + s + 3 * s**2 / 7 + 2 * s**3 / 21 + s**4 / 105}
    matern = polynomials[kernel.nu] * np.exp(-s)
    m = kernel.inputs
    return np.asarray(matern * (1 + kernel.growth * X[:, -m:] @ Z[:, -m:].T) + constant + slope * X @ Z.T)


@given(families, seeds)
def test_covariances_are_those_of_the_formula(family: tuple[float, float, int], seed: int) -> None:
    kernel, rng = ResidualKernel(*family), np.random.default_rng(seed)
    X, Z, theta = rng.normal(size=(7, 4)), rng.normal(size=(5, 4)), theta_of(kernel, 4, rng)
    np.testing.assert_allclose(kernel(theta, X, Z), direct(kernel, theta, X, Z), rtol=1e-10, atol=1e-10)


@given(families, seeds)
def test_the_diagonal_is_that_of_the_matrix(family: tuple[float, float, int], seed: int) -> None:
    kernel, rng = ResidualKernel(*family), np.random.default_rng(seed)
    X, theta = 3 * rng.normal(size=(9, 4)), theta_of(kernel, 4, rng)
    np.testing.assert_allclose(kernel.diagonal(theta, X), np.diag(kernel(theta, X, X)), rtol=1e-10)


@given(families, seeds, st.integers(2, 40))
def test_the_matrix_is_positive_semidefinite(family: tuple[float, float, int], seed: int, count: int) -> None:
    kernel, rng = ResidualKernel(*family), np.random.default_rng(seed)
    X, theta = rng.normal(size=(count, 4)), theta_of(kernel, 4, rng)
    K = kernel(theta, X, X)
    np.testing.assert_allclose(K, K.T, rtol=1e-12, atol=1e-12 * np.trace(K))
    assert np.linalg.eigvalsh(K).min() >= -1e-12 * np.trace(K)


@every_family
def test_gradients_are_those_of_finite_differences(nu: float, growth: float, inputs: int) -> None:
    kernel, rng = ResidualKernel(nu, growth, inputs), np.random.default_rng(3)
    X, half = rng.normal(size=(12, 4)), rng.normal(size=(12, 12))
    W = half + half.T
    theta = np.array([0.3, -0.4, 1.0, 0.1, 0.5, -0.7])
    steps = 1e-6 * np.eye(6)
    differences = [((kernel(theta + h, X, X) - kernel(theta - h, X, X)) * W).sum() / 2e-6 for h in steps]
    np.testing.assert_allclose(kernel.with_gradient(theta, X)[1](W), differences, rtol=1e-6, atol=1e-6)


def test_with_growth_the_deviation_is_proportional_to_large_inputs() -> None:
    kernel, theta = ResidualKernel(2.5, 1.0, 1), np.array([0.0, 0.0, -30.0, -30.0])
    deviations = np.sqrt(kernel.diagonal(theta, np.array([[0.0, 100.0], [0.0, 200.0]])))
    assert deviations[1] / deviations[0] == pytest.approx(2, rel=1e-3)
