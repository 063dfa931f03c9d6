"""The study of tests at drawn tasks: its designs, and that what it stores belongs to its systems."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from ctxval.certificates.prediction_tests import TESTS
from study_drawn_tests import DESIGNS, LIFTS, POSTS, STORED, WIDEST, power_table, without_gaps


@pytest.mark.parametrize("design", DESIGNS)
def test_a_design_draws_tasks_all_over_the_space(design: str) -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([DESIGNS[design](3, rng) for _ in range(100)])
    assert points.shape == (100 * TESTS, 3)
    assert ((points >= 0) & (points <= 1)).all()
    counts = np.stack([np.histogram(column, bins=5, range=(0, 1))[0] for column in points.T])
    assert counts.min() > 50


def test_tests_without_gaps_leave_none() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        values = np.sort(without_gaps(2, rng), axis=0)
        gaps = np.diff(np.vstack([np.zeros(2), values, np.ones(2)]), axis=0)
        assert gaps.max() <= WIDEST + 1e-12


def test_each_system_has_a_stored_power_of_each_design() -> None:
    assert {line["entry"] for line in STORED.select(what="power")} == {*LIFTS, *POSTS}
    assert all("nan" not in cell for row in power_table() for cell in row)
    (bin_,) = (line for line in STORED.select(entry="heavy-bin", what="power", seed=0))
    assert bin_["met"]["hypercube"] == 1.0
