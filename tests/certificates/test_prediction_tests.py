"""Tests at tasks where nobody chose to look."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates.prediction_tests import TESTS, WIDEST, fewest_missing_tests, fewest_spread_tests
from ctxval.certificates.prediction_tests import next_spread_test as next_test

SEEDS = st.integers(0, 2**32 - 1)


def spread_out(points: np.ndarray, seed: int) -> np.ndarray:
    """Return the points with all spread tests that they need."""
    rng = np.random.default_rng(seed)
    while fewest_spread_tests(points):
        points = np.vstack([points, next_test(points, rng)])
    return points


@given(SEEDS, st.integers(1, 12), st.integers(0, 12))
def test_each_spread_test_leaves_one_less(seed: int, dimension: int, known: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.random((known, dimension)) ** 2
    needed = fewest_spread_tests(points)
    assert needed <= TESTS
    assert len(spread_out(points, seed)) == known + needed
    task = next_test(points, rng)
    assert ((task >= 0) & (task <= 1)).all()


@given(SEEDS, st.integers(1, 6), st.floats(0, 1 - WIDEST))
def test_an_interval_of_a_parameter_is_met_with_certainty_if_it_is_wider(seed: int, dimension: int, low: float) -> None:
    points = spread_out(np.empty((0, dimension)), seed)
    assert len(points) == TESTS
    inside = (points >= low - 1e-9) & (points <= low + WIDEST + 1e-9)
    assert inside.any(axis=0).all()


def test_tests_are_not_at_the_same_places_in_each_campaign() -> None:
    values = np.array([spread_out(np.empty((0, 1)), seed)[:, 0] for seed in range(200)])
    counts, _ = np.histogram(values, bins=10, range=(0, 1))
    assert counts.min() > 0.3 * counts.mean()


@pytest.mark.parametrize(
    ("points", "drawn", "tests", "missing"),
    [
        (np.empty((0, 2)), 0, 0, 0),
        (np.empty((0, 2)), 0, 8, 8),
        (np.linspace(0, 1, 10)[:, None], 0, 8, 8),
        (np.linspace(0, 1, 10)[:, None], 8, 8, 0),
        (np.linspace(0, 1, 5)[:, None], 8, 8, 8),
        (np.linspace(0, 1, 5)[:, None], 8, 20, 12),
    ],
)
def test_both_kinds_of_tests_must_be_complete(points: np.ndarray, drawn: int, tests: int, missing: int) -> None:
    assert fewest_missing_tests(points, drawn, tests) == missing
