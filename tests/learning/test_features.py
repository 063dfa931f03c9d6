from __future__ import annotations

import numpy as np
import pytest

from ctxval.gp.kernels import Matern
from ctxval.learning.features import Features, spread_rows


def features(centres: int = 12, seed: int = 0) -> Features:
    Z = np.random.default_rng(seed).normal(size=(centres, 4))
    return Features.of(Z, np.array([1.0, 2.0, 0.5, 1.5]), 0.7, states=3, inputs=1)


def test_at_the_centres_the_covariance_is_that_of_the_process() -> None:
    made = features()
    matern = made(made.centres)[:, : len(made.centres)]
    expected = Matern(2.5, ard=True)(made.theta, made.centres, made.centres)
    assert matern @ matern.T == pytest.approx(expected, abs=1e-6)


def test_a_function_is_the_sum_of_the_features() -> None:
    made, rng = features(), np.random.default_rng(1)
    z = rng.normal(size=(9, 4))
    phi = made(z)
    weights = rng.normal(size=(2, phi.shape[1], 3))
    rows = [np.array([0, 3, 4]), np.array([1, 2, 5, 6, 7, 8])]
    values = made.values(z, [(own, made.function(w)) for own, w in zip(rows, weights, strict=True)])
    for own, w in zip(rows, weights, strict=True):
        assert values[own] == pytest.approx(phi[own] @ w)


def test_the_linear_part_holds_inputs_times_states() -> None:
    made = features()
    z = np.array([[1.0, 2.0, 3.0, 0.5]])
    assert made(z)[0, len(made.centres) :] == pytest.approx(0.7 * np.array([1, 1, 2, 3, 0.5, 0.15, 0.3, 0.45]))


def test_spread_rows_are_far_from_each_other() -> None:
    Z = np.array([[0.0], [0.1], [5.0], [5.1], [10.0]])
    assert sorted(spread_rows(Z, 3).tolist()) == [0, 2, 4]
    assert len(spread_rows(Z, 9)) == 5
