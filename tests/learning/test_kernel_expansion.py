from __future__ import annotations

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.learning.hyperparameters import ResidualHyperparameters, ResidualKernel
from ctxval.learning.kernel_expansion import KernelExpansion, joined


def expansion(nu: float, growth: float, functions: int, inputs: int = 1) -> KernelExpansion:
    rng = np.random.default_rng(0)
    theta = np.log([0.5, 2.0, 10.0, 0.3, 4.0])
    own = ResidualHyperparameters(ResidualKernel(nu, growth, inputs), theta, 1e-6)
    return KernelExpansion.of(own, rng.normal(size=(17, 3)), rng.normal(size=(functions, 17, 2)))


def direct(one: KernelExpansion, z: Array) -> Array:
    """Return the sums of covariances, one function after the other."""
    parts = zip(one.thetas, z, one.centres, one.weights, strict=True)
    return np.stack([one.kernel(theta, own, centres) @ weights for theta, own, centres, weights in parts])


@pytest.mark.parametrize("nu", [1.5, 2.5, 4.5])
@pytest.mark.parametrize(("growth", "inputs"), [(0.0, 1), (1.0, 1), (1.0, 2), (0.3, 2)])
@pytest.mark.parametrize(("functions", "arguments"), [(1, 1), (1, 512), (1, 1300), (3, 170), (3, 171), (2, 513)])
def test_values_are_the_sums_of_covariances(
    nu: float, growth: float, inputs: int, functions: int, arguments: int
) -> None:
    one = expansion(nu, growth, functions, inputs)
    z = 2 * np.random.default_rng(1).normal(size=(functions, arguments, 3))
    np.testing.assert_allclose(one(z), direct(one, z), rtol=1e-9, atol=1e-9)


def test_no_arguments_give_no_values() -> None:
    assert expansion(2.5, 1.0, 3)(np.empty((3, 0, 3))).shape == (3, 0, 2)


def test_at_a_centre_and_far_from_all_centres_values_are_exact() -> None:
    one = expansion(1.5, 0.0, 1)
    z = np.stack([one.centres[0, 4], np.full(3, 1e6), np.full(3, -1e6)])[None]
    np.testing.assert_allclose(one(z), direct(one, z), rtol=1e-7)


def test_arguments_are_not_changed() -> None:
    z = np.random.default_rng(1).normal(size=(2, 40, 3))
    before = z.copy()
    expansion(2.5, 1.0, 2)(z)
    np.testing.assert_array_equal(z, before)


def test_joined_functions_are_the_same_functions() -> None:
    """Their centres differ in number and hyperparameters, and one has another family."""
    rng, parts = np.random.default_rng(2), []
    for nu, functions, centres in ((2.5, 2, 17), (2.5, 3, 11), (1.5, 1, 17)):
        own = ResidualHyperparameters(ResidualKernel(nu, 0.0, 1), rng.normal(size=5), 1e-6)
        parts.append(KernelExpansion.of(own, rng.normal(size=(centres, 3)), rng.normal(size=(functions, centres, 2))))
    together = joined(parts)
    assert [len(one.weights) for one in together] == [5, 1]
    z = rng.normal(size=(6, 40, 3))
    expected = [direct(one, own) for one, own in zip(parts, np.split(z, [2, 5]), strict=True)]
    found = [one(own) for one, own in zip(together, np.split(z, [5]), strict=True)]
    np.testing.assert_allclose(np.concatenate(found), np.concatenate(expected), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(together[0][[1, 3]](z[[1, 3]]), found[0][[1, 3]], rtol=1e-9, atol=1e-9)
