"""Simulation-based calibration of the residual dynamics, in a fast version of the study."""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ctxval.learning.hyperparameters import ResidualHyperparameters, ResidualKernel

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import study_posterior_ranks as study  # noqa: E402


@pytest.mark.parametrize("growth", [0.0, 1.0])
def test_functions_of_the_prior_have_its_covariance_also_if_drawn_in_parts(growth: float) -> None:
    own = ResidualHyperparameters(ResidualKernel(2.5, growth, 1), np.log([1.0, 2.0, 0.5, 0.3]), 1e-6)
    Z, states = np.random.default_rng(0).normal(size=(5, 2)), 20_000
    drawn = study.PriorResidual(own, states, np.random.default_rng(1))
    values = np.concatenate([drawn(part) for part in np.split(Z, [2, 3])])
    expected = own.kernel(own.theta, Z, Z)
    errors = np.sqrt((np.outer(np.diag(expected), np.diag(expected)) + expected**2) / states)
    assert (np.abs(np.cov(values) - expected) <= 5 * errors).all()


def test_a_function_of_the_prior_keeps_the_values_that_it_had() -> None:
    own = ResidualHyperparameters(ResidualKernel(1.5, 1.0, 1), np.log([1.0, 2.0, 3.0, 0.5, 0.3]), 1e-6)
    Z = np.random.default_rng(0).normal(size=(20, 3))
    drawn = study.PriorResidual(own, 2, np.random.default_rng(1))
    np.testing.assert_allclose(drawn(Z), drawn(Z), atol=1e-3)


def test_a_rank_is_the_number_of_draws_below_and_equal_ones_are_ordered_at_random() -> None:
    drawn = np.array([[1.0, 5.0, np.inf], [2.0, 6.0, np.inf], [3.0, 7.0, np.inf]])
    rng = np.random.default_rng(0)
    ranks = np.array([study.ranked(np.array([2.5, 4.0, np.inf]), drawn, rng) for _ in range(4000)])
    assert (ranks[:, 0] == 2).all()
    assert (ranks[:, 1] == 0).all()
    assert stats.chisquare(np.bincount(ranks[:, 2], minlength=4)).pvalue > 1e-3


@pytest.mark.slow
@pytest.mark.thorough
def test_ranks_of_the_truth_among_draws_are_uniform() -> None:
    # Those with few transitions, which are fast.
    seeds = [seed for seed in range(30) if study.COUNTS[seed % 4] <= 60]
    results = [study.ranks("pairs", states, seed) for seed, states in product(seeds, (1, 2, 3))]
    for of in ("residual", "distance"):
        each = np.array([result[of] for result in results])
        assert each.min() >= 0
        assert each.max() < study.RANKS
        # Ranks of one system depend on each other, so the test of uniformity takes one of each.
        fifths = np.bincount(each[:, 0] * 5 // study.RANKS, minlength=5)
        assert stats.chisquare(fifths).pvalue > 1e-3
        # Draws that are too narrow leave the truth outside of all of them more often than twice in twenty.
        outside = np.isin(each, [0, study.RANKS - 1]).mean(axis=1)
        error = outside.std() / np.sqrt(len(outside))
        assert outside.mean() < 2 / study.RANKS + 3 * error
