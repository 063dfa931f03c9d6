"""Sums of kernels, and their derivatives, against scikit-learn's kernels and complex steps."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.gaussian_process import kernels as sklearn_kernels

from ctxval.models import kernel_maps
from ctxval.models.kernel_maps import Kernel, KernelSum

RNG = np.random.default_rng(0)
CENTRES, WEIGHTS, ROWS = RNG.normal(size=(7, 3)), RNG.normal(size=(7, 2)), RNG.normal(size=(4, 3))
SCALES = np.array([1.0, 2.0, 0.7])

SQUARED = kernel_maps.squared_exponential(SCALES)
LINEAR = kernel_maps.of_products(lambda p: p + 0.25, lambda p: 1.0)
KERNELS: dict[str, tuple[Kernel | None, object]] = {
    "squared": (SQUARED, sklearn_kernels.RBF(SCALES)),
    **{
        f"matern {nu}": (kernel_maps.matern(SCALES, nu), sklearn_kernels.Matern(SCALES, nu=nu))
        for nu in (0.5, 1.5, 2.5, np.inf)
    },
    "rational": (
        kernel_maps.rational_quadratic(0.8, 1.7),
        sklearn_kernels.RationalQuadratic(length_scale=0.8, alpha=1.7),
    ),
    "linear": (LINEAR, sklearn_kernels.DotProduct(0.5)),
    "total": (
        kernel_maps.total(kernel_maps.constant(0.3), kernel_maps.total(SQUARED, LINEAR)),
        0.3 + (sklearn_kernels.RBF(SCALES) + sklearn_kernels.DotProduct(0.5)),
    ),
    "product": (
        kernel_maps.product(kernel_maps.constant(2.0), kernel_maps.product(SQUARED, LINEAR)),
        2.0 * (sklearn_kernels.RBF(SCALES) * sklearn_kernels.DotProduct(0.5)),
    ),
    "power": (kernel_maps.power(LINEAR, 3.0), sklearn_kernels.DotProduct(0.5) ** 3),
    "constant": (kernel_maps.constant(2.0), sklearn_kernels.ConstantKernel(2.0)),
}


@pytest.mark.parametrize("name", KERNELS)
def test_a_sum_of_kernels_is_that_of_scikit_learn_with_its_derivatives(name: str) -> None:
    kernel, theirs = KERNELS[name]
    assert kernel is not None
    smooth = KernelSum(kernel, CENTRES, WEIGHTS)
    np.testing.assert_allclose(smooth.value(ROWS), theirs(ROWS, CENTRES) @ WEIGHTS, rtol=1e-12, atol=1e-13)
    h, found = 1e-5, smooth.jacobian(ROWS)
    moves = h * np.eye(3)
    # Differences of the fourth order, of scikit-learn's kernel.
    at = [np.stack([theirs(ROWS + k * move, CENTRES) @ WEIGHTS for move in moves], -1) for k in (-2, -1, 1, 2)]
    expected = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)


def test_at_a_centre_the_derivatives_are_finite() -> None:
    for name in ("matern 0.5", "matern 1.5", "squared"):
        kernel, _ = KERNELS[name]
        assert kernel is not None
        assert np.isfinite(KernelSum(kernel, CENTRES, WEIGHTS).jacobian(CENTRES)).all()


def test_a_matern_kernel_of_another_smoothness_is_not_known() -> None:
    assert kernel_maps.matern(1.0, 3.2) is None
