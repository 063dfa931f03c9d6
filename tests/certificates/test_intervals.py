"""Intervals of a mean and of a quantile: their coverage in 1e5 simulated campaigns, and references."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from ctxval.certificates.intervals import (
    asymptotic_interval,
    betting_interval,
    log_wealth_against,
    mean_of_predictions,
    quantile_ranks,
)

CAMPAIGNS = 100_000


def simulated(rng: np.random.Generator, shape: tuple[int, ...], kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return distances in [0, 1] with predictions: good ones, useless ones, or distances that are rarely large."""
    p = rng.random(shape)
    if kind == "good":
        return p**2, np.clip(p**2 + 0.05 * rng.standard_normal(shape) + 0.1, 0, 1)
    if kind == "useless":
        return p**2, rng.random(shape)
    return np.where(p > 0.97, 1.0, 0.05 * p), 0.05 * p


MEANS = {"good": 1 / 3, "useless": 1 / 3, "rare": 0.03 + 0.05 * 0.97**2 / 2}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(MEANS))
@pytest.mark.parametrize("above", [True, False])
def test_bets_reject_the_true_mean_as_rarely_as_stated(kind: str, above: bool) -> None:
    """1e5 campaigns of 40 draws; the bets may stop at any of them."""
    rng, beta = np.random.default_rng(7), 0.1
    values, predicted = simulated(rng, (CAMPAIGNS, 40), kind)
    centre = float(simulated(rng, (4_000_000,), kind)[1].mean()), 1e-3
    wealth = log_wealth_against(values, predicted, centre, 1.0, MEANS[kind], beta, above=above)
    rejected = (wealth.max(axis=1) >= np.log(2 / beta)).mean()
    assert rejected <= beta / 2 + 4 * np.sqrt(beta / CAMPAIGNS)


def test_wealth_is_one_on_average_at_the_true_mean() -> None:
    """Two-point values: the expectation is a sum over all outcomes, so this is exact."""
    outcomes = np.array(np.meshgrid(*[[0.0, 1.0]] * 8)).reshape(8, -1).T
    share = 0.3
    probability = np.prod(np.where(outcomes == 1, share, 1 - share), axis=1)
    predicted = np.tile([0.2, 0.9, 0.4, 0.4, 0.1, 0.0, 1.0, 0.6], (len(outcomes), 1))
    for above in (True, False):
        plain = np.exp(log_wealth_against(outcomes, 0 * predicted, (0.0, 0.0), 1.0, share, 0.05, above=above))
        np.testing.assert_allclose(probability @ plain, 1.0, rtol=1e-12)


@pytest.mark.parametrize(("kind", "least"), [("good", 0.935), ("useless", 0.935)])
def test_the_asymptotic_interval_covers_as_often_as_stated(kind: str, least: float) -> None:
    rng, held, runs, widths = np.random.default_rng(8), 0, 4000, []
    for _ in range(runs):
        values, predicted = simulated(rng, (40,), kind)
        interval = asymptotic_interval(values, predicted, simulated(rng, (400,), kind)[1], 0.05)
        held += interval.low <= MEANS[kind] <= interval.high
        widths.append(interval.high - interval.low)
    assert least <= held / runs <= 0.965
    plain = 2 * stats.t.ppf(0.975, 39) * np.sqrt((4 / 45) / 40)
    assert (np.mean(widths) < 0.5 * plain) == (kind == "good")


def test_the_asymptotic_interval_is_too_narrow_where_large_distances_are_rare() -> None:
    """Why it is called asymptotic, and why a largest possible distance should be stated."""
    rng, held, betting, runs = np.random.default_rng(9), 0, 0, 300
    for _ in range(runs):
        values, predicted = simulated(rng, (30,), "rare")
        elsewhere = simulated(rng, (400,), "rare")[1]
        asymptotic = asymptotic_interval(values, predicted, elsewhere, 0.05)
        finite = betting_interval(values, predicted, elsewhere, 1.0, 0.05)
        held += asymptotic.low <= MEANS["rare"] <= asymptotic.high
        betting += finite.low <= MEANS["rare"] <= finite.high
    assert held / runs < 0.7
    assert betting / runs >= 0.95


def test_without_a_prediction_it_is_students_interval() -> None:
    values = np.random.default_rng(2).random(25)
    found = asymptotic_interval(values, np.zeros(25), np.zeros(100), 0.1)
    assert found.weight == 0
    assert found.variance_left == 1
    assert found.estimate == pytest.approx(values.mean())
    half = stats.t.ppf(0.95, 23) * values.std(ddof=1) / 5
    assert found.high - found.low == pytest.approx(2 * half)


def test_a_perfect_prediction_leaves_the_error_of_its_own_mean() -> None:
    rng = np.random.default_rng(3)
    values, elsewhere = rng.random(20), rng.random(200_000)
    found = asymptotic_interval(values, values, elsewhere, 0.05)
    assert found.weight == pytest.approx(1, abs=1e-3)
    assert abs(found.estimate - 0.5) < 0.003
    assert found.high - found.low < 0.004


@given(st.lists(st.floats(0, 1), min_size=3, max_size=30), st.floats(0.01, 0.3), st.floats(0.1, 100.0))
def test_bets_know_no_units_and_more_confidence_is_wider(values: list[float], beta: float, scale: float) -> None:
    rng = np.random.default_rng(len(values))
    drawn, predicted, elsewhere = np.array(values), rng.random(len(values)), rng.random(200)
    found = betting_interval(drawn, predicted, elsewhere, 1.0, beta)
    scaled = betting_interval(scale * drawn, scale * predicted, scale * elsewhere, scale, beta)
    assert scaled.low == pytest.approx(scale * found.low, abs=1e-8 * scale)
    assert scaled.high == pytest.approx(scale * found.high, abs=1e-8 * scale)
    assert 0 <= found.low <= found.estimate <= found.high <= 1
    surer = betting_interval(drawn, predicted, elsewhere, 1.0, beta / 4)
    assert surer.low <= found.low + 0.02
    assert surer.high >= found.high - 0.02


def test_many_draws_and_a_good_prediction_narrow_the_interval() -> None:
    rng, widths = np.random.default_rng(5), {}
    for n in (20, 80, 400):
        values, predicted = simulated(rng, (n,), "good")
        elsewhere = simulated(rng, (200_000,), "good")[1]
        for name, used in (("powered", predicted), ("plain", 0 * predicted)):
            found = betting_interval(values, used, elsewhere if name == "powered" else 0 * elsewhere, 1.0, 0.05)
            widths[n, name] = found.high - found.low
    assert widths[400, "powered"] < widths[80, "powered"] < widths[20, "powered"]
    assert widths[400, "powered"] < 0.7 * widths[400, "plain"]


def test_the_mean_of_predictions_is_bounded_as_often_as_stated() -> None:
    rng, beta = np.random.default_rng(6), 0.2
    drawn = rng.random((5000, 60)) ** 3
    missed = np.mean(
        [abs(mean - 0.25) > error for mean, error in (mean_of_predictions(one, 1.0, beta) for one in drawn)]
    )
    assert missed <= beta


# Quantiles


def least_coverage(n: int, level: float, beta: float) -> tuple[float, float]:
    """Return the exact probabilities that the lower and the upper limit hold, for a continuous distribution."""
    low, high = quantile_ranks(n, level, beta)
    below = 1.0 if low is None else 1 - sum(math.comb(n, j) * level**j * (1 - level) ** (n - j) for j in range(low))
    above = 1.0 if high is None else sum(math.comb(n, j) * level**j * (1 - level) ** (n - j) for j in range(high))
    return below, above


@given(st.integers(1, 120), st.floats(0.01, 0.99), st.floats(0.001, 0.5))
def test_each_side_of_a_quantile_holds_with_its_probability_and_no_rank_is_closer(
    n: int, level: float, beta: float
) -> None:
    low, high = quantile_ranks(n, level, beta)
    below, above = least_coverage(n, level, beta)
    assert min(below, above) >= 1 - beta / 2 - 1e-9
    if low is not None and low < n:
        assert stats.binom.cdf(low, n, level) > beta / 2 - 1e-9
    if high is not None and high > 1:
        assert stats.binom.cdf(high - 2, n, level) < 1 - beta / 2 + 1e-9


def test_a_quantile_is_between_its_limits_as_often_as_stated() -> None:
    rng, n, level, beta = np.random.default_rng(1), 50, 0.9, 0.1
    ordered = np.sort(rng.random((CAMPAIGNS, n)), axis=1)
    low, high = quantile_ranks(n, level, beta)
    assert low is not None
    assert high is not None
    held = ((ordered[:, low - 1] <= level) & (level <= ordered[:, high - 1])).mean()
    assert held >= 1 - beta - 4 * np.sqrt(beta * (1 - beta) / CAMPAIGNS)
    assert held == pytest.approx(sum(least_coverage(n, level, beta)) - 1, abs=0.004)
