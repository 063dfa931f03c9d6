"""Bets that something has changed: they gain nothing on average if nothing has, and much if something has."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from ctxval._util.arrays import Array
from ctxval.certificates.expiry import CHANGES, KnownStatistics, ScaleBets, SlopeBets


def known(values: Array, freedom: float | None) -> KnownStatistics:
    return KnownStatistics(np.array(values.sum()), np.log(values).sum(), len(values), freedom)


@pytest.mark.parametrize("freedom", [None, 1.0, 20.0])
@pytest.mark.parametrize("count", [3, 15])
def test_a_predictive_density_integrates_to_one(freedom: float | None, count: int) -> None:
    values = np.random.default_rng(1).chisquare(4, count) / 4
    logs = np.linspace(-60, 60, 12_001)
    before = known(values, freedom)
    whole = KnownStatistics(np.full(len(logs), before.sums), np.full(len(logs), before.logs), count, freedom)
    assert np.trapezoid(np.exp(whole.log_density(np.exp(logs))), logs) == pytest.approx(1, abs=1e-3)


def test_the_law_of_known_noise_is_scaled_chi_square() -> None:
    """Many statistics of four degrees of freedom predict the next one as the exact law does."""
    rng = np.random.default_rng(2)
    before = known(rng.chisquare(4, 5000) / 4, 4.0)
    v = 1.7
    exact = np.log(v) + np.log(2 * 2 * v * np.exp(-2 * v))  # Gamma with shape 2 and mean 1, of the logarithm
    assert float(before.log_density(np.array(v))) == pytest.approx(exact, abs=0.05)


@pytest.mark.slow
def test_bets_gain_nothing_on_average_if_nothing_has_changed() -> None:
    rng = np.random.default_rng(3)
    means = []
    for _ in range(150):
        bets = ScaleBets.before(rng.chisquare(4, 12) / 4, 4.0)
        for value in rng.chisquare(4, 3) / 4:
            bets = bets.after(value)
        means.append(np.exp(bets.products).mean(axis=0))
    assert (np.mean(means, axis=0) < 1.1).all()


@pytest.mark.slow
def test_coefficients_gain_nothing_on_average_if_only_the_certified_runs_left_them_uncertain() -> None:
    rng, k = np.random.default_rng(4), 3
    certified = 12.0 * np.eye(k)
    means = []
    for _ in range(300):
        w, bets = rng.standard_normal(k) / np.sqrt(12), SlopeBets.before(certified, 1.0)
        for _ in range(3):
            bets = bets.after(w + rng.standard_normal(k), np.eye(k))
        means.append(np.exp(bets.products).mean(axis=0))
    assert (np.mean(means, axis=0) < 1.1).all()


def test_a_small_change_that_is_the_same_in_all_runs_is_seen_by_coefficients() -> None:
    rng, k = np.random.default_rng(5), 3
    bets, scales = SlopeBets.before(30.0 * np.eye(k), 1.0), ScaleBets.before(rng.chisquare(k, 30) / k, float(k))
    for _ in range(12):
        gradient = np.array([2.0, 0.0, 0.0]) + rng.standard_normal(k)
        bets, scales = bets.after(gradient, np.eye(k)), scales.after(float(gradient @ gradient) / k)
    of_coefficients = logsumexp(bets.products)
    assert of_coefficients > np.log(1000)
    assert of_coefficients > logsumexp(scales.products)


def test_one_run_is_no_proof_and_a_second_is_as_surprising() -> None:
    bets = ScaleBets.before(np.ones(12), None)
    first = bets.after(1e4)
    second = first.after(1e4)
    assert np.exp(first.products).max() <= 200.001  # one outlier in 200 is nothing
    assert np.exp(second.products[:, 0]).max() > 100 * np.exp(first.products).max()
    calm = first
    for _ in range(20):
        calm = calm.after(1.0)
    assert np.exp(calm.products).sum() / len(CHANGES.scales) < 21  # what it is on average, if nothing has changed


def test_a_change_back_to_normal_wins_nothing() -> None:
    bets = ScaleBets.before(np.random.default_rng(6).chisquare(4, 12) / 4, None)
    for _ in range(30):
        bets = bets.after(0.01)  # smaller than certified: the model predicts better than it did
    assert np.exp(bets.products).sum() / len(CHANGES.scales) < 30
