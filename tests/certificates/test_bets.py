"""Linear bets on bounded values, against their definition."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ctxval._util.arrays import Array
from ctxval.certificates.bets import log_wealth_of_bets, weights_so_far

SEEDS = st.integers(0, 10**6)


def earlier(values: Array) -> Array:
    return np.cumsum(values, axis=-1) - values


@given(SEEDS)
def test_the_wealth_is_the_product_of_limited_bets(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gains, wanted, room = rng.uniform(-1, 1, 20), rng.uniform(0, 3, 20), rng.uniform(0, 1, 20)
    factors = [
        1 + max(-0.75, min(bet, 0.75 / most) * gain) for gain, bet, most in zip(gains, wanted, room, strict=True)
    ]
    np.testing.assert_allclose(log_wealth_of_bets(gains, wanted, room), np.log(np.cumprod(factors)), atol=1e-12)


@given(SEEDS)
def test_no_draw_loses_more_than_three_quarters(seed: int) -> None:
    rng = np.random.default_rng(seed)
    room = rng.uniform(0, 1, 30)
    wealth = log_wealth_of_bets(-room * rng.random(30), np.full(30, 1e9), room)
    assert np.diff(wealth, prepend=0.0).min() >= np.log(0.25) - 1e-9


@given(SEEDS)
def test_a_weight_is_the_slope_among_earlier_draws(seed: int) -> None:
    rng = np.random.default_rng(seed)
    predicted = rng.random(12)
    values = 0.6 * predicted + 0.1 * rng.normal(size=12)
    weights = weights_so_far(values, predicted, earlier)
    assert (weights[:3] == 1).all()
    slopes = [np.polyfit(predicted[:k], values[:k], 1)[0] for k in range(3, 12)]
    np.testing.assert_allclose(weights[3:], np.clip(slopes, 0, 1), atol=1e-6)
    changed = np.append(values[:-1], 9.0)
    np.testing.assert_allclose(weights_so_far(changed, predicted, earlier), weights, atol=1e-9)
