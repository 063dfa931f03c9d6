from __future__ import annotations

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.errors import InputError, ModelError
from ctxval.models import Expected, Linear
from ctxval.testing import check_model
from facts import refuses


def square(x: Array, u: Array, w: Array) -> Array:
    return np.asarray((x + u + 0.5 * w) ** 2)


def test_it_conforms() -> None:
    check_model(Expected(square, noise=1), states=1, inputs=1)


def test_linear_noise_averages_out_exactly() -> None:
    linear = Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])
    noisy = Expected(lambda x, u, w: linear.step(x, u) + w * [0.1, 0.2], noise=2, draws=8)
    x, u = np.random.default_rng(0).normal(size=(5, 2)), np.ones((5, 1))
    np.testing.assert_allclose(noisy.step(x, u), linear.step(x, u), atol=1e-14)


def test_the_expectation_of_a_square_has_the_variance_of_the_noise() -> None:
    expected = Expected(square, noise=1, draws=4001).step(np.array([[1.0], [-2.0]]), np.array([[0.5], [0.5]]))
    assert expected[:, 0] == pytest.approx([1.5**2 + 0.25, 1.5**2 + 0.25], rel=0.02)


def test_the_draws_follow_from_the_seed_and_are_even() -> None:
    one, again, other = (Expected(square, noise=2, draws=5, seed=seed) for seed in (3, 3, 4))
    assert one.draws.shape == (6, 2)
    assert (one.draws == again.draws).all()
    assert (one.draws != other.draws).any()


def test_bad_input_is_named() -> None:
    with refuses(InputError, "noise", 0):
        Expected(square, noise=0)
    wrong = Expected(lambda x, u, w: x[..., 0], noise=1)
    with refuses(ModelError, (64, 2), (64,)):
        wrong.step(np.zeros(2), np.zeros(1))
