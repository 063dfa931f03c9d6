from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process import kernels as oracle

from ctxval.errors import InputError
from ctxval.gp import regression
from ctxval.gp.cholesky import factorise
from ctxval.gp.kernels import Matern
from facts import refuses
from rig_thorough import more

KERNELS: dict[str, Matern] = {
    "matern32": Matern(1.5),
    "matern52": Matern(2.5),
    "matern32-ard": Matern(1.5, ard=True),
    "matern52-ard": Matern(2.5, ard=True),
    "linear": Matern(1.5, ard=True, linear=(1e-4, 50.0)),
}
THETA = {
    "matern32": np.log([1.7, 0.4]),
    "matern52": np.log([0.6, 0.8]),
    "matern32-ard": np.log([1.7, 0.4, 0.9]),
    "matern52-ard": np.log([0.6, 0.8, 0.3]),
    "linear": np.log([1.2, 0.5, 0.7, 0.3, 1.5]),
}
NOISE = 0.01
every_kernel = pytest.mark.parametrize("name", KERNELS)
every_mean = pytest.mark.parametrize("mean", [regression.zero_mean, lambda X: np.sin(3 * X[:, 0]) + X[:, 1] ** 2])


def data(n: int = 14, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    X = rng.random((n, 2))
    return X, np.sin(5 * X[:, 0]) + X[:, 1] + 0.1 * rng.normal(size=n)


def where(m: int = 8) -> np.ndarray:
    return np.random.default_rng(99).random((m, 2))


def oracle_kernel(name: str) -> oracle.Kernel:
    kernel, values = KERNELS[name], np.exp(THETA[name])
    if kernel.linear is not None:
        matern = oracle.ConstantKernel(values[0]) * oracle.Matern(values[1:3], nu=1.5)
        return matern + oracle.ConstantKernel(values[4]) * oracle.DotProduct(np.sqrt(values[3] / values[4]))
    return oracle.ConstantKernel(values[0]) * oracle.Matern(values[1:], nu=kernel.nu)


def likelihood_of(process: regression.GaussianProcess) -> float:
    residual = process.y - process.mean(process.X)
    return regression.log_marginal_likelihood(process.kernel, process.theta, process.noise, process.X, residual)[0]


def differences(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, h: float = 1e-6) -> np.ndarray:
    return np.stack([(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))], axis=-1)


# Against scikit-learn and the textbook


@every_kernel
@pytest.mark.parametrize("n", [1, 2, 14])
def test_the_posterior_is_that_of_scikit_learn(name: str, n: int) -> None:
    X, y = data(n)
    process = regression.condition(KERNELS[name], THETA[name], X, y, noise=NOISE)
    # The linear kernel of scikit-learn is about the origin, ours about the middle of the cube; the others do not move.
    reference = GaussianProcessRegressor(oracle_kernel(name), alpha=NOISE, optimizer=None).fit(X - 0.5, y)
    mean, deviation = reference.predict(where() - 0.5, return_std=True)
    ours, variance = process.predict(where())
    np.testing.assert_allclose(ours, mean, rtol=0, atol=1e-8)
    np.testing.assert_allclose(variance, deviation**2, rtol=0, atol=1e-8)
    assert likelihood_of(process) == pytest.approx(reference.log_marginal_likelihood(), abs=1e-8)


@pytest.mark.parametrize("name", [name for name in KERNELS if name.startswith("matern")])
def test_the_likelihood_and_its_gradient_with_the_noise_are_those_of_scikit_learn(name: str) -> None:
    X, y = data()
    noisy = oracle_kernel(name) + oracle.WhiteKernel(NOISE)
    reference = GaussianProcessRegressor(noisy, alpha=0.0, optimizer=None).fit(X, y)
    value, gradient = reference.log_marginal_likelihood(noisy.theta, eval_gradient=True)
    ours, our_gradient = regression.log_marginal_likelihood(KERNELS[name], THETA[name], NOISE, X, y)
    assert ours == pytest.approx(value, abs=1e-8)
    np.testing.assert_allclose(our_gradient, gradient, rtol=1e-8, atol=1e-8)


@every_kernel
@every_mean
def test_the_posterior_is_the_textbook_formula(name: str, mean: regression.Mean) -> None:
    kernel, theta, (X, y), Z = KERNELS[name], THETA[name], data(), where()
    process = regression.condition(kernel, theta, X, y, noise=NOISE, mean=mean)
    K, k = kernel(theta, X, X) + NOISE * np.eye(len(X)), kernel(theta, Z, X)
    posterior, variance = process.predict(Z)
    np.testing.assert_allclose(posterior, mean(Z) + k @ np.linalg.solve(K, y - mean(X)), rtol=0, atol=1e-9)
    covariance = kernel(theta, Z, Z) - k @ np.linalg.solve(K, k.T)
    np.testing.assert_allclose(variance, np.diag(covariance), rtol=0, atol=1e-9)


def test_an_observation_left_out_is_predicted_by_all_others() -> None:
    X, y = data(8)
    whole = regression.condition(KERNELS["linear"], THETA["linear"], X, y, noise=NOISE)
    mean, variance = whole.left_out()
    for i in range(8):
        rest = np.arange(8) != i
        others = regression.condition(KERNELS["linear"], THETA["linear"], X[rest], y[rest], noise=NOISE)
        expected, uncertain = others.predict(X[i : i + 1])
        assert mean[i] == pytest.approx(expected[0])
        assert variance[i] == pytest.approx(uncertain[0] + NOISE)


def test_without_noise_the_process_goes_through_its_observations() -> None:
    X, y = data(6)
    mean, variance = regression.condition(Matern(2.5), np.log([1.0, 0.2]), X, y, noise=1e-10).predict(X)
    np.testing.assert_allclose(mean, y, atol=1e-6)
    np.testing.assert_allclose(variance, 0, atol=1e-8)


def test_far_from_observations_the_process_is_its_prior() -> None:
    X, y = data(6)
    process = regression.condition(Matern(1.5), np.log([1.3, 0.1]), X, y, mean=lambda X: X[:, 0])
    mean, variance = process.predict(np.array([[30.0, 30.0]]))
    np.testing.assert_allclose(mean, 30.0, rtol=1e-12)
    np.testing.assert_allclose(variance, 1.3, rtol=1e-12)


def test_the_variance_is_never_negative_and_never_above_the_prior() -> None:
    X, y = data(40)
    process = regression.condition(Matern(2.5), np.log([1.3, 3.0]), X, y, noise=1e-6)
    variance = process.predict(np.concatenate([X, where(200)]))[1]
    assert (variance >= 0).all()
    assert (variance <= 1.3 + 1e-12).all()


def test_rounding_does_not_make_a_variance_negative() -> None:
    X = np.array([[0.5, 0.5]])
    for variance in np.linspace(0.1, 3.0, 200):
        certain = regression.condition(Matern(), np.log([variance, 0.4]), X, np.ones(1), noise=0.0)
        assert certain.predict(X)[1][0] >= 0
        assert certain.predict_with_gradient(X)[1][0] >= 0


def test_a_prior_mean_acts_as_subtracting_it_from_the_observations() -> None:
    X, y = data()
    mean = lambda X: 3 * X[:, 0] - X[:, 1]  # noqa: E731
    with_mean = regression.condition(Matern(), THETA["matern32"], X, y, mean=mean)
    without = regression.condition(Matern(), THETA["matern32"], X, y - mean(X))
    np.testing.assert_allclose(with_mean.predict(where())[0], mean(where()) + without.predict(where())[0], rtol=1e-12)
    assert likelihood_of(with_mean) == pytest.approx(likelihood_of(without), rel=1e-12)


# Gradients


@every_kernel
@pytest.mark.parametrize("noise", [1e-2, 0.05])
def test_the_gradient_of_the_likelihood_agrees_with_finite_differences(name: str, noise: float) -> None:
    kernel, (X, y) = KERNELS[name], data()
    parameters = np.append(THETA[name], np.log(noise))

    def likelihood(p: np.ndarray) -> np.ndarray:
        return np.asarray(regression.log_marginal_likelihood(kernel, p[:-1], float(np.exp(p[-1])), X, y)[0])

    gradient = regression.log_marginal_likelihood(kernel, parameters[:-1], noise, X, y)[1]
    np.testing.assert_allclose(gradient, differences(likelihood, parameters, 1e-5), rtol=1e-6, atol=1e-5)


@every_kernel
@every_mean
def test_the_gradients_of_mean_and_variance_agree_with_finite_differences(name: str, mean: regression.Mean) -> None:
    X, y = data()
    process = regression.condition(KERNELS[name], THETA[name], X, y, noise=NOISE, mean=mean)
    d_mean, d_variance = process.predict_with_gradient(where())[2:]
    for i, point in enumerate(where()):
        numeric = differences(lambda x: np.array(process.predict(x[None])), point)[:, 0, :]
        np.testing.assert_allclose(d_mean[i], numeric[0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(d_variance[i], numeric[1], rtol=1e-6, atol=1e-6)


@every_kernel
@every_mean
def test_predictions_with_gradients_are_the_predictions_and_the_gradients(name: str, mean: regression.Mean) -> None:
    process = regression.condition(KERNELS[name], THETA[name], *data(), noise=NOISE, mean=mean)
    together = process.predict_with_gradient(where())
    apart = (*process.predict(where()), *process.predict_with_gradient(where())[2:])
    for one, other in zip(together, apart, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-10)


@pytest.mark.parametrize("m", [1, 5])
def test_predictions_have_one_value_and_one_gradient_a_point(m: int) -> None:
    process = regression.condition(Matern(), THETA["matern32"], *data(3))
    assert [part.shape for part in process.predict(where(m))] == [(m,), (m,)]
    assert [part.shape for part in process.predict_with_gradient(where(m))[2:]] == [(m, 2), (m, 2)]


def test_many_points_are_predicted_as_they_are_one_by_one() -> None:
    process = regression.condition(KERNELS["linear"], THETA["linear"], *data())
    one_by_one = np.array([np.ravel(process.predict(point[None])) for point in where()])
    np.testing.assert_allclose(np.transpose(process.predict(where())), one_by_one, rtol=1e-10, atol=1e-12)


# Fitting


def oracle_optimum(kernel: Matern, X: np.ndarray, y: np.ndarray, noise: tuple[float, float]) -> float:
    """Return the best likelihood that scikit-learn finds within the same bounds from ten starts."""
    bounds = np.exp(kernel.bounds(2))
    scale = oracle.Matern(np.ones(2) if kernel.ard else 1.0, tuple(bounds[1]), nu=kernel.nu)
    covariance = oracle.ConstantKernel(1.0, tuple(bounds[0])) * scale
    if noise[0] < noise[1]:
        covariance += oracle.WhiteKernel(float(np.sqrt(noise[0] * noise[1])), noise)
    alpha = 0.0 if noise[0] < noise[1] else noise[0]
    regressor = GaussianProcessRegressor(covariance, alpha=alpha, n_restarts_optimizer=9, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return float(regressor.fit(X, y).log_marginal_likelihood_value_)


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
@pytest.mark.parametrize("noise", [(regression.NOISE, regression.NOISE), (1e-6, 1.0)])
@pytest.mark.parametrize("kernel", [Matern(1.5), Matern(2.5, ard=True)])
def test_the_fit_is_as_likely_as_the_best_of_scikit_learn(
    kernel: Matern, noise: tuple[float, float], seed: int
) -> None:
    X, y = data(20, seed)
    y = (y - y.mean()) / y.std()
    fitted = regression.fit(kernel, X, y, noise=noise)
    assert likelihood_of(fitted) >= oracle_optimum(kernel, X, y, noise) - 1e-6


@every_kernel
def test_the_fit_stays_within_the_bounds(name: str) -> None:
    kernel, (X, y) = KERNELS[name], data()
    process = regression.fit(kernel, X, y, noise=(1e-5, 1e-2))
    low, high = np.array(kernel.bounds(2)).T
    assert ((process.theta >= low - 1e-12) & (process.theta <= high + 1e-12)).all()
    assert 1e-5 * (1 - 1e-12) <= process.noise <= 1e-2 * (1 + 1e-12)


def test_equal_noise_bounds_fix_the_noise() -> None:
    assert regression.fit(Matern(), *data(), noise=(0.02, 0.02)).noise == pytest.approx(0.02, rel=1e-12)


def test_the_noise_of_the_data_is_found() -> None:
    rng = np.random.default_rng(0)
    X = rng.random((150, 2))
    y = np.sin(5 * X[:, 0]) + 0.3 * rng.normal(size=150)
    assert regression.fit(Matern(2.5), X, y, noise=(1e-6, 1.0)).noise == pytest.approx(0.09, rel=0.3)


def test_the_fit_climbs_from_every_given_start() -> None:
    X, y = data()
    low, high = np.array([*Matern().bounds(2), (np.log(1e-6),) * 2]).T
    starts = np.random.default_rng(0).uniform(low, high, (3, 3))
    fitted = likelihood_of(regression.fit(Matern(), X, y, starts=starts))
    for start in starts:
        before, _ = regression.log_marginal_likelihood(Matern(), start[:-1], regression.NOISE, X, y)
        assert fitted >= before
    # A single start is one of them: more starts never make a less likely fit.
    assert fitted >= likelihood_of(regression.fit(Matern(), X, y, starts=starts[:1]))


def test_a_sharp_prior_of_the_hyperparameters_is_respected() -> None:
    target = np.log([0.9, 0.33, regression.NOISE])

    def sharp(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        gap = parameters - target
        return -0.5e8 * float(gap @ gap), -1e8 * gap

    np.testing.assert_allclose(regression.fit(Matern(), *data(), log_prior=sharp).theta, target[:-1], atol=1e-4)


def test_the_mode_with_a_prior_has_a_vanishing_gradient() -> None:
    X, y = data(20)
    noise = (1e-6, 1.0)

    def prior(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        gap = parameters - np.log([1.0, 0.5, 0.01])
        return -2.0 * float(gap @ gap), -4.0 * gap

    process = regression.fit(Matern(), X, y, noise=noise, log_prior=prior)
    parameters = np.append(process.theta, np.log(process.noise))
    gradient = (
        regression.log_marginal_likelihood(Matern(), process.theta, process.noise, X, y)[1] + prior(parameters)[1]
    )
    np.testing.assert_allclose(gradient, 0, atol=2e-3)


def test_the_fit_uses_the_prior_mean() -> None:
    X, _ = data()
    mean = lambda X: np.sin(5 * X[:, 0]) + X[:, 1]  # noqa: E731
    residual = 1e-1 * data(seed=5)[1]
    with_mean = regression.fit(Matern(), X, mean(X) + residual, mean=mean)
    np.testing.assert_allclose(with_mean.theta, regression.fit(Matern(), X, residual).theta, atol=1e-6)


# What is refused


def test_a_covariance_that_is_not_positive_definite_is_refused() -> None:
    X = np.zeros((5, 2))
    with refuses(InputError, 5, "noise"):
        regression.condition(Matern(), THETA["matern32"], X, np.zeros(5), noise=0.0)


def test_a_point_that_is_no_number_is_refused() -> None:
    X, y = data()
    X[3, 0] = np.nan
    with refuses(InputError, 14):
        regression.condition(Matern(), THETA["matern32"], X, y)


def test_outputs_that_share_a_covariance_are_as_likely_as_each_alone() -> None:
    rng = np.random.default_rng(5)
    X, Y, theta = rng.random((9, 2)), rng.normal(size=(9, 3)), np.log([1.5, 0.4])
    value, W = regression.log_likelihood_of_outputs(Matern(1.5)(theta, X, X), 0.01, Y)
    alone = [regression.log_marginal_likelihood(Matern(1.5), theta, 0.01, X, y) for y in Y.T]
    assert value - 0.5 * Y.size * np.log(2 * np.pi) == pytest.approx(sum(one for one, _ in alone), rel=1e-12)
    gradient = np.append(Matern(1.5).weighted_gradient(theta, X, W), 0.01 * np.trace(W))
    np.testing.assert_allclose(gradient, sum(slope for _, slope in alone), rtol=1e-9)


def test_a_process_of_several_outputs_is_one_of_each() -> None:
    rng = np.random.default_rng(5)
    X, Y, theta = rng.random((9, 2)), rng.normal(size=(9, 3)), np.log([1.5, 0.4])
    together = regression.MultiOutputProcess(Matern(1.5), theta, X, Y, NOISE)
    alone = [regression.condition(Matern(1.5), theta, X, y, noise=NOISE) for y in Y.T]
    mean, variance = together.predict(where())
    for k, process in enumerate(alone):
        np.testing.assert_allclose(mean[:, k], process.predict(where())[0], rtol=1e-10)
        np.testing.assert_allclose(variance, process.predict(where())[1], rtol=1e-10)
        np.testing.assert_allclose(together.left_out(np.arange(9))[:, k], process.left_out()[0], rtol=1e-10)


def test_points_too_much_alike_are_given_more_noise() -> None:
    X, Y = np.zeros((5, 2)), np.arange(5.0)[:, None]
    process = regression.MultiOutputProcess(Matern(), THETA["matern32"], X, Y, 1e-18)
    K = process.kernel(process.theta, X, X)
    with refuses(InputError, 5):
        factorise(K, process.noise)  # it vanishes beside the variances
    np.testing.assert_allclose(process.factor.L @ process.factor.L.T, K, rtol=1e-12)
    noisy = regression.MultiOutputProcess(Matern(), THETA["matern32"], X, Y, 1e-3)
    np.testing.assert_allclose(noisy.predict(X)[0], 2.0, rtol=1e-3)


def test_hyperparameters_without_a_positive_definite_covariance_are_impossible() -> None:
    def log_density(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        if parameters[0] < 0:
            raise InputError("not positive definite")
        return -float((parameters[0] - 0.3) ** 2), -2 * (parameters - 0.3)

    found = regression.most_likely(log_density, np.array([[-1.0], [0.5]]), [(-2.0, 2.0)])
    np.testing.assert_allclose(found, 0.3, atol=1e-5)
    best = regression.most_likely(log_density, np.array([[-1.0], [0.5]]), [(-2.0, 2.0)], best_start=True)
    np.testing.assert_allclose(best, 0.3, atol=1e-5)
