"""Noise that is other in a part of the states."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval.learning.local_noise import local_noise


@pytest.mark.parametrize("states", [2, 5])
def test_noise_that_begins_at_an_edge_is_not_smoothed_away(states: int) -> None:
    rng = np.random.default_rng(0)
    pairs, others = rng.standard_normal((2, 1000, states))
    innovations = np.where(pairs[:, 0] > 1, 1.0, 0.05) * rng.standard_normal(1000)
    size = np.sqrt((innovations**2).mean())
    local = local_noise(pairs, innovations[:, None] / size)
    assert local is not None
    learned = size * local(others)
    np.testing.assert_allclose(learned[others[:, 0] > 1.05], 1.0, rtol=0.2)
    np.testing.assert_allclose(learned[others[:, 0] < 0.9], 0.05, rtol=0.2)


def test_noise_that_grows_smoothly_is_averaged_over_neighbours() -> None:
    rng = np.random.default_rng(1)
    pairs = rng.standard_normal((1500, 2))
    truth = np.exp(0.3 * pairs[:, 1])
    local = local_noise(pairs, (truth * rng.standard_normal(1500))[:, None])
    assert local is not None
    assert np.corrcoef(np.log(local(pairs)), np.log(truth))[0, 1] > 0.7


def test_noise_that_is_the_same_everywhere_is_not_local() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert local_noise(rng.standard_normal((800, 4)), rng.standard_normal((800, 2))) is None


def test_without_noise_there_is_nothing_to_learn() -> None:
    assert local_noise(np.zeros((5, 2)), np.zeros((5, 0))) is None
