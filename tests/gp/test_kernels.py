from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from sklearn.gaussian_process import kernels as oracle

from ctxval.errors import InputError
from ctxval.gp.kernels import Matern
from facts import refuses

D = 3
KERNELS: dict[str, Matern] = {
    "matern32": Matern(1.5),
    "matern52": Matern(2.5),
    "matern92": Matern(4.5),
    "matern32-ard": Matern(1.5, ard=True),
    "matern52-ard": Matern(2.5, ard=True),
    "matern92-ard": Matern(4.5, ard=True),
    "linear": Matern(1.5, linear=(1e-4, 50.0)),
    "linear-ard": Matern(2.5, ard=True, linear=(1e-2, 5.0)),
}
MATERN = [name for name in KERNELS if name.startswith("matern")]
every_kernel = pytest.mark.parametrize("name", KERNELS)


def theta_of(kernel: Matern, seed: int = 0) -> np.ndarray:
    low, high = np.array(kernel.bounds(D)).T
    return low + (0.3 + 0.4 * np.random.default_rng(seed).random(len(low))) * (high - low)


def points(n: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).random((n, D))


def oracle_of(kernel: Matern, theta: np.ndarray) -> oracle.Kernel:
    scales = np.exp(theta[1:])
    return oracle.ConstantKernel(np.exp(theta[0])) * oracle.Matern(scales if kernel.ard else scales[0], nu=kernel.nu)


def differences(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Return d function / dx by central differences, derivative last."""
    return np.stack([(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))], axis=-1)


@pytest.mark.parametrize("name", MATERN)
def test_a_matern_covariance_and_its_gradient_are_those_of_scikit_learn(name: str) -> None:
    kernel, X = KERNELS[name], points(9)
    theta = theta_of(kernel)
    K, gradient = oracle_of(kernel, theta)(X, eval_gradient=True)
    np.testing.assert_allclose(kernel(theta, X, X), K, rtol=1e-10)
    np.testing.assert_allclose(kernel(theta, X, points(4, 2)), oracle_of(kernel, theta)(X, points(4, 2)), rtol=1e-10)
    factor = np.random.default_rng(3).normal(size=(9, 9))
    W = factor + factor.T
    # scikit-learn has formulas for 3/2 and 5/2, and finite differences for other kernels.
    accuracy = 1e-3 if kernel.nu == 4.5 else 1e-9
    np.testing.assert_allclose(
        kernel.weighted_gradient(theta, X, W), np.einsum("ij,ijk->k", W, gradient), rtol=accuracy, atol=accuracy
    )


def test_the_linear_part_adds_the_dot_product_of_scikit_learn_about_the_middle() -> None:
    plain, kernel, X, Z = Matern(1.5, ard=True), Matern(1.5, ard=True, linear=(0.1, 9.0)), points(9), points(4, 2)
    theta = theta_of(plain)
    dot = oracle.ConstantKernel(3.0) * oracle.DotProduct(np.sqrt(0.7 / 3.0))
    expected = plain(theta, X, Z) + dot(X - 0.5, Z - 0.5)
    np.testing.assert_allclose(kernel(np.append(theta, np.log([0.7, 3.0])), X, Z), expected, rtol=1e-12)


@every_kernel
def test_the_bounds_are_one_interval_for_each_hyperparameter(name: str) -> None:
    kernel = KERNELS[name]
    low, high = np.array(kernel.bounds(D)).T
    assert (low < high).all()
    gradient = kernel.weighted_gradient(theta_of(kernel), points(4), np.eye(4))
    assert gradient.shape == low.shape


def test_bounds_are_natural_logarithms_of_the_given_ranges() -> None:
    kernel = Matern(ard=True, length_scale=(0.1, 2.0), variance=(0.5, 3.0))
    np.testing.assert_allclose(np.exp(kernel.bounds(2)), [[0.5, 3.0], [0.1, 2.0], [0.1, 2.0]], rtol=1e-14)
    linear = Matern(linear=(0.1, 9.0)).bounds(5)
    np.testing.assert_allclose(np.exp(linear[2:]), [[0.1, 9.0]] * 2, rtol=1e-14)


@every_kernel
def test_shapes_are_points_by_points(name: str) -> None:
    kernel, X, Z = KERNELS[name], points(5), points(4, 2)
    theta = theta_of(kernel)
    assert kernel(theta, X, Z).shape == (5, 4)
    assert kernel.diagonal(theta, X).shape == (5,)
    assert kernel.input_gradient(theta, X, Z).shape == (5, 4, D)
    assert kernel.diagonal_input_gradient(theta, X).shape == (5, D)


@every_kernel
@pytest.mark.parametrize("seed", range(4))
def test_a_covariance_matrix_is_symmetric_and_positive_semidefinite(name: str, seed: int) -> None:
    kernel, X = KERNELS[name], points(15, seed)
    K = kernel(theta_of(kernel, seed), X, X)
    np.testing.assert_allclose(K, K.T, rtol=0, atol=1e-14 * np.abs(K).max())
    assert np.linalg.eigvalsh(K).min() > -1e-10 * np.abs(K).max()


@every_kernel
def test_the_diagonal_is_that_of_the_covariance_matrix(name: str) -> None:
    kernel, X = KERNELS[name], points(6)
    np.testing.assert_allclose(
        kernel.diagonal(theta_of(kernel), X), np.diag(kernel(theta_of(kernel), X, X)), rtol=1e-12
    )


@every_kernel
def test_the_gradient_in_theta_agrees_with_finite_differences(name: str) -> None:
    kernel, X, theta = KERNELS[name], points(7), theta_of(KERNELS[name])
    factor = np.random.default_rng(4).normal(size=(7, 7))
    W = factor + factor.T
    numeric = differences(lambda t: (W * kernel(t, X, X)).sum(), theta)
    np.testing.assert_allclose(kernel.weighted_gradient(theta, X, W), numeric, rtol=1e-7, atol=1e-7)


@every_kernel
def test_the_gradients_in_the_points_agree_with_finite_differences(name: str) -> None:
    kernel, X, Z, theta = KERNELS[name], points(5), points(4, 2), theta_of(KERNELS[name])
    for i in range(len(X)):
        numeric = differences(lambda x: kernel(theta, x[None], Z)[0], X[i])
        np.testing.assert_allclose(kernel.input_gradient(theta, X, Z)[i], numeric, rtol=1e-6, atol=1e-7)
        numeric = differences(lambda x: kernel.diagonal(theta, x[None])[0], X[i])
        np.testing.assert_allclose(kernel.diagonal_input_gradient(theta, X)[i], numeric, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", MATERN)
def test_a_matern_covariance_has_no_slope_where_points_meet(name: str) -> None:
    kernel, X = KERNELS[name], points(3)
    gradient = kernel.input_gradient(theta_of(kernel), X, X)
    np.testing.assert_array_equal(gradient[np.arange(3), np.arange(3)], 0)


@pytest.mark.parametrize("name", ["matern32-ard", "matern52-ard", "matern92-ard"])
def test_equal_length_scales_are_the_isotropic_kernel(name: str) -> None:
    kernel, X = KERNELS[name], points(6)
    isotropic, theta = Matern(kernel.nu), np.log([2.0, 0.4])
    np.testing.assert_allclose(kernel(np.log([2.0, 0.4, 0.4, 0.4]), X, X), isotropic(theta, X, X), rtol=1e-13)


@pytest.mark.parametrize("nu", [0.5, 2, 3.5, np.inf])
def test_another_smoothness_is_refused_by_value(nu: float) -> None:
    with refuses(InputError, 1.5, 2.5, nu):
        Matern(nu)
