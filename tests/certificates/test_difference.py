"""The sign of an expected difference, decided at any time."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ctxval.certificates.difference import (
    MeanDifference,
    PairedDifferences,
    _by_symmetry,
    _log_wealth_of_bets,
    _weights_so_far,
    mean_difference,
)

NUMBERS = st.floats(-1e3, 1e3, allow_nan=False)


def paired(values: object, predicted: object = None, most: float | None = None) -> PairedDifferences:
    found = np.asarray(values, dtype=np.float64)
    return PairedDifferences(found, np.zeros_like(found) if predicted is None else np.asarray(predicted), most)


@pytest.mark.parametrize("recent", [True, False])
@given(sizes=hnp.arrays(np.float64, 7, elements=st.floats(0, 100)))
def test_the_expected_wealth_is_one_if_the_signs_are_fair(sizes: np.ndarray, recent: bool) -> None:
    signs = np.array(list(product([-1.0, 1.0], repeat=7)))
    wealth = np.exp(_by_symmetry(signs * sizes, recent=recent))
    np.testing.assert_allclose(wealth.mean(axis=0), 1.0, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.thorough
@given(values=hnp.arrays(np.float64, 12, elements=NUMBERS), factor=st.floats(1e-3, 1e3))
def test_swapping_and_scaling_carry_over(values: np.ndarray, factor: float) -> None:
    one, other = mean_difference(paired(values), 0.05), mean_difference(paired(-values), 0.05)
    scaled = mean_difference(paired(factor * values), 0.05)
    assert (one.sign, one.decided_after) == (-other.sign, other.decided_after)
    assert (one.sign, one.decided_after) == (scaled.sign, scaled.decided_after)
    assert one.low <= (one.estimate or 0.0) <= one.high
    np.testing.assert_allclose([one.low, one.high], [-other.high, -other.low], rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@given(values=hnp.arrays(np.float64, st.integers(0, 20), elements=NUMBERS), end=st.integers(0, 20))
def test_a_decision_stays(values: np.ndarray, end: int) -> None:
    early, late = mean_difference(paired(values[:end]), 0.2), mean_difference(paired(values), 0.2)
    assert early.sign in (0, late.sign)


def share_decided(draws: np.ndarray, beta: float, most: float | None = None) -> float:
    """Return in how many rows the sign is ever decided, whenever a comparison stops."""
    level, none = np.log(2 / beta), np.array(0.0)

    def ever(row: np.ndarray) -> bool:
        found = paired(row, most=most)
        return any(found.log_wealth(none, above=above)[-1] >= level for above in (True, False))

    return float(np.mean([ever(row) for row in draws]))


@pytest.mark.slow
def test_the_sign_of_nothing_is_seldom_decided_whenever_one_stops() -> None:
    rng, beta = np.random.default_rng(0), 0.1
    allowed = beta + 3 * np.sqrt(beta * (1 - beta) / 300)
    assert share_decided(rng.normal(size=(300, 80)), beta) < allowed
    assert share_decided(rng.standard_t(2, size=(300, 80)), beta) < allowed
    # A rare large loss: no test without a bound would see it, and with a bound every distribution is allowed.
    rare = 0.05 - (rng.random((300, 80)) < 0.05)
    assert share_decided(rare, beta, most=1.0) < allowed < share_decided(rare, beta)
    assert share_decided(rng.choice([-1.0, 1.0], size=(300, 80)), beta, most=1.0) < allowed
    losing = np.where(rng.random((300, 80)) < 0.05, -1.0, 0.05)
    assert share_decided(losing, beta) > 0.5  # the wrong sign in most comparisons, as docs/theory.md says


@pytest.mark.slow
def test_intervals_cover_whenever_one_stops() -> None:
    rng, beta, missed = np.random.default_rng(1), 0.1, 0
    for _ in range(20):
        values = 0.3 + rng.normal(size=60)
        found = [mean_difference(paired(values[:n]), beta) for n in range(20, 61, 20)]
        missed += any(not one.low <= 0.3 <= one.high for one in found)
    assert missed <= 20 * beta + 3 * np.sqrt(20 * beta * (1 - beta))


def test_a_good_prediction_decides_with_fewer_tasks() -> None:
    rng = np.random.default_rng(2)
    predicted = rng.normal(size=60)
    values = 0.1 + predicted + 0.02 * rng.normal(size=60)
    plain, helped = mean_difference(paired(values), 0.05), mean_difference(paired(values, predicted), 0.05)
    assert plain.sign == 0
    assert helped.sign == 1
    assert helped.decided_after is not None
    assert helped.decided_after < 15
    assert helped.variance_left is not None
    assert helped.variance_left < 0.01
    assert helped.low < 0.1 < helped.high


def test_a_useless_prediction_gets_no_weight() -> None:
    rng = np.random.default_rng(3)
    values, predicted = 1.0 + rng.normal(size=60), rng.normal(size=60)
    found = mean_difference(paired(values, predicted), 0.05)
    assert found.sign == 1
    assert found.estimate == pytest.approx(1.0, abs=0.5)


def test_few_tasks_decide_nothing() -> None:
    assert mean_difference(paired([]), 0.05) == MeanDifference(None, -np.inf, np.inf, 0, None, 0, None)
    few = mean_difference(paired([1.0, 1.1, 0.9]), 0.05)
    assert (few.sign, few.low, few.high) == (0, -np.inf, np.inf)
    assert mean_difference(paired(np.zeros(50)), 0.05).sign == 0


def test_with_a_largest_distance_the_interval_is_within_it() -> None:
    found = mean_difference(paired([0.2, 0.3], most=2.0), 0.05)
    assert -2.0 <= found.low < found.high <= 2.0
    many = mean_difference(paired(np.full(200, 0.5), most=1.0), 0.05)
    assert many.sign == 1
    assert 0 < many.low < 0.5 < many.high < 1


SEEDS = st.integers(0, 10**6)


@given(SEEDS)
def test_the_wealth_is_the_product_of_limited_bets(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gains, wanted, room = rng.uniform(-1, 1, 20), rng.uniform(0, 3, 20), rng.uniform(0, 1, 20)
    factors = [
        1 + max(-0.75, min(bet, 0.75 / most) * gain) for gain, bet, most in zip(gains, wanted, room, strict=True)
    ]
    np.testing.assert_allclose(_log_wealth_of_bets(gains, wanted, room), np.log(np.cumprod(factors)), atol=1e-12)
    at_worst = _log_wealth_of_bets(-room * rng.random(20), np.full(20, 1e9), room)
    assert np.diff(at_worst, prepend=0.0).min() >= np.log(0.25) - 1e-9


@given(SEEDS)
def test_a_weight_is_the_slope_among_recent_earlier_tasks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    predicted = rng.random(12)
    values = 0.6 * predicted + 0.1 * rng.normal(size=12)
    weights = _weights_so_far(values, predicted)
    assert (weights[:3] == 1).all()
    slopes = [np.polyfit(predicted[k // 2 : k], values[k // 2 : k], 1)[0] for k in range(6, 12)]
    np.testing.assert_allclose(weights[6:], np.clip(slopes, 0, 1), atol=1e-6)
    np.testing.assert_allclose(_weights_so_far(np.append(values[:-1], 9.0), predicted), weights, atol=1e-9)
