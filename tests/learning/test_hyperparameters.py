from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal, multivariate_t

from ctxval._util.arrays import Array
from ctxval.errors import InputError
from ctxval.learning.hyperparameters import (
    FAMILIES,
    HyperparameterPosterior,
    HyperparameterPrior,
    ResidualHyperparameters,
    ResidualKernel,
    _resampled,
    draw_prior,
    learning_rows,
    log_posterior,
)
from facts import refuses

KERNEL = ResidualKernel(2.5, 1.0, 1)
LEAST, MOST = HyperparameterPrior().noise_bounds
PARAMETERS = np.log([1.5, 0.7, 2.0, 0.3, 0.01])


def observations(count: int = 12, states: int = 2, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    Z = rng.normal(size=(count, 2))
    return Z, np.stack([np.sin((1 + i) * Z[:, 0]) + 0.3 * Z[:, 1] for i in range(states)], axis=1)


def log_prior(parameters: Array) -> float:
    """Return the log of the log-normal prior, as the module states it."""
    means, deviations = np.log([3.0, 3.0, 1.0, 1.0, 1e-6]), np.array([1.0, 1.0, 5.0, 5.0, 4.0])
    return float(-0.5 * (((parameters - means) / deviations) ** 2).sum())


def covariance(parameters: Array, Z: Array) -> Array:
    return np.asarray(KERNEL(parameters[:-1], Z, Z) + np.exp(parameters[-1]) * np.eye(len(Z)))


def log_evidence(y: Array, K: Array) -> float:
    """Return the log of the normal density integrated over the log of the amplitude."""

    def density(log_amplitude: float) -> float:
        return float(np.exp(multivariate_normal.logpdf(y, cov=np.exp(2 * log_amplitude) * K)))

    return float(np.log(quad(density, -6, 6, epsabs=0, epsrel=1e-10, limit=200)[0]))


def test_the_likelihood_has_the_amplitudes_integrated_out() -> None:
    Z, Y = observations()
    other = PARAMETERS + np.array([0.3, -0.2, 0.5, 1.0, -0.6])
    expected = [sum(log_evidence(y, covariance(at, Z)) for y in Y.T) + log_prior(at) for at in (PARAMETERS, other)]
    found = [log_posterior(KERNEL, at, Z, Y)[0] for at in (PARAMETERS, other)]
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], rel=1e-7)


def test_the_likelihood_is_the_limit_of_a_multivariate_t() -> None:
    Z, Y = observations(30, 3)
    other = PARAMETERS - np.array([0.5, 0.3, -0.5, 0.2, 1.0])
    expected = [
        sum(multivariate_t.logpdf(y, shape=covariance(at, Z), df=1e-9) for y in Y.T) + log_prior(at)
        for at in (PARAMETERS, other)
    ]
    found = [log_posterior(KERNEL, at, Z, Y)[0] for at in (PARAMETERS, other)]
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], rel=1e-6)


@pytest.mark.parametrize(("nu", "growth"), FAMILIES)
def test_the_gradient_is_that_of_finite_differences(nu: float, growth: float) -> None:
    kernel, (Z, Y) = ResidualKernel(nu, growth, 1), observations(20)
    differences = [
        (log_posterior(kernel, PARAMETERS + h, Z, Y)[0] - log_posterior(kernel, PARAMETERS - h, Z, Y)[0]) / 2e-5
        for h in 1e-5 * np.eye(5)
    ]
    np.testing.assert_allclose(log_posterior(kernel, PARAMETERS, Z, Y)[1], differences, rtol=1e-5, atol=1e-5)


def test_beyond_the_bounds_only_the_prior_changes() -> None:
    Z, Y = observations()
    bound, beyond = PARAMETERS.copy(), PARAMETERS.copy()
    bound[-1], beyond[-1] = (
        np.log(LEAST),
        np.log(LEAST) - 3,
    )
    difference = log_posterior(KERNEL, beyond, Z, Y)[0] - log_posterior(KERNEL, bound, Z, Y)[0]
    assert difference == pytest.approx(log_prior(beyond) - log_prior(bound))


def test_the_scale_of_the_residuals_does_not_matter() -> None:
    Z, Y = observations()
    gradients = [log_posterior(KERNEL, PARAMETERS, Z, Y * size)[1] for size in (1.0, np.array([1e-6, 1e3]))]
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-6)


def test_a_covariance_that_is_not_finite_is_refused() -> None:
    Z, Y = observations()
    with refuses(InputError, 12):
        log_posterior(KERNEL, PARAMETERS * np.nan, Z, Y)


def test_no_draw_is_more_probable_than_the_mode() -> None:
    Z, Y = observations(25)
    posterior = HyperparameterPosterior.given(Z, Y, 1, FAMILIES)
    drawn = posterior.draw(10, np.random.default_rng(0))
    assert len(drawn) == 10

    def density(one: ResidualHyperparameters) -> float:
        return log_posterior(one.kernel, np.append(one.theta, np.log(one.noise)), Z, Y)[0]

    assert density(posterior.mode) >= max(map(density, drawn)) - 1e-6


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_draws_can_be_taken(count: int) -> None:
    posterior = HyperparameterPosterior.given(*observations(6), 1, FAMILIES[:1])
    assert len(posterior.draw(count, np.random.default_rng(0))) == count


def test_equal_draws_are_the_same_object_and_follow_each_other() -> None:
    drawn = HyperparameterPosterior.given(*observations(6), 1, FAMILIES[:1]).draw(60, np.random.default_rng(0))
    names = [id(one) for one in drawn]
    changes = sum(one != other for one, other in pairwise(names))
    assert changes + 1 == len(set(names)) < 60


def test_rows_are_resampled_in_proportion_to_truncated_weights() -> None:
    weights = np.ones(144)
    weights[7] = 1000.0
    rows = _resampled(np.log(weights), 10_000, np.random.default_rng(0))
    largest = weights.mean() * 12
    assert (rows == 7).mean() == pytest.approx(largest / (largest + 143), abs=1e-3)


def test_rows_without_weight_are_never_drawn() -> None:
    rows = _resampled(np.array([-np.inf, 0.0, -np.inf, 0.0]), 1000, np.random.default_rng(0))
    np.testing.assert_array_equal(np.bincount(rows, minlength=4), [0, 500, 0, 500])


@pytest.mark.slow
def test_draws_have_the_moments_of_the_posterior() -> None:
    Z, Y = observations(10, 1)
    rng = np.random.default_rng(0)
    prior = [draw_prior(2, 1, rng) for _ in range(5_000)]
    parameters = np.array([np.append(one.theta, np.log(one.noise)) for one in prior if one.kernel == KERNEL])
    # Prior draws, weighted by the likelihood: slow and crude, but without any approximation of the shape.
    log_weights = np.array([log_posterior(KERNEL, at, Z, Y)[0] - log_prior(at) for at in parameters])
    weights = np.exp(log_weights - log_weights.max())
    mean = np.average(parameters, axis=0, weights=weights)
    deviation = np.sqrt(np.average((parameters - mean) ** 2, axis=0, weights=weights))
    posterior = HyperparameterPosterior.given(Z, Y, 1, [(2.5, 1.0)])
    drawn = [np.append(one.theta, np.log(one.noise)) for _ in range(40) for one in posterior.draw(19, rng)]
    np.testing.assert_allclose((np.mean(drawn, axis=0) - mean) / deviation, 0, atol=0.25)
    np.testing.assert_allclose(np.std(drawn, axis=0) / deviation, 1, atol=0.25)


def test_draws_of_the_prior_have_its_medians_within_the_bounds() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_prior(3, 1, rng) for _ in range(3000)]
    theta = np.array([one.theta for one in drawn])
    np.testing.assert_allclose(np.median(theta, axis=0), np.log([3, 3, 3, 1, 1]), atol=0.3)
    np.testing.assert_allclose(theta[:, :3].std(axis=0), 1, atol=0.05)
    low, high = (ends[:-1] for ends in ResidualKernel(2.5, 0.0, 1).box(3))
    assert ((theta >= low) & (theta <= high)).all()
    assert all(0.999 * LEAST < one.noise < 1.001 * MOST for one in drawn)
    families = [(one.kernel.nu, one.kernel.growth) for one in drawn]
    assert [families.count(family) / 3000 for family in FAMILIES] == pytest.approx([1 / 3] * 3, abs=0.04)


def test_rows_to_learn_from_are_spread_over_the_pairs() -> None:
    rng = np.random.default_rng(0)
    Z = np.concatenate([1e-4 * rng.normal(size=(200, 2)), rng.normal(size=(20, 2))])
    rows = learning_rows(Z, 1, 20)
    assert len(set(rows.tolist())) == 20
    assert (rows >= 200).sum() >= 15


# Covariance


KERNELS = [(nu, growth, inputs) for nu in (1.5, 2.5, 4.5) for growth in (0.0, 1.0, 0.3) for inputs in (1, 2)]
every_family = pytest.mark.parametrize(("nu", "growth", "inputs"), KERNELS)
families = st.sampled_from(KERNELS)
seeds = st.integers(0, 2**32 - 1)


def theta_of(kernel: ResidualKernel, dimension: int, rng: np.random.Generator) -> Array:
    low, high = (ends[:-1] for ends in kernel.box(dimension))
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
