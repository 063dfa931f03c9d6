"""The plants without rates: what they record, and that their stored truths are those of their tasks."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from calibrate_outputs import IMPERFECTIONS_TRIED, PLANTS, TRUTHS, recorded, rows, without_rates
from rig_thorough import some

NAMES = sorted({name for name, _ in TRUTHS})


def test_all_plants_but_one_have_rates_that_can_be_left_out() -> None:
    assert set(PLANTS) - set(NAMES) == {"tanks"}
    assert {imperfection for _, imperfection in TRUTHS} == set(IMPERFECTIONS_TRIED)


@pytest.mark.parametrize("name", some(NAMES, 3))
def test_a_stored_truth_is_reached_at_its_task_and_exceeded_by_no_other(name: str) -> None:
    validation = without_rates(PLANTS[name], "none")
    truth = TRUTHS[name, "none"]
    at = validation.space.from_unit(np.array([truth["point"]]))
    assert validation.distances(at) == pytest.approx([truth["distance"]], rel=1e-6)
    others = validation.distances(validation.space.iid(64, np.random.default_rng(0)))
    assert (others <= truth["distance"] * (1 + 1e-6)).all()
    assert validation.plan(at[0]).model_trajectory.states.shape[-1] == len(recorded(PLANTS[name]))


def test_the_table_has_a_row_for_each_imperfection() -> None:
    assert [row[0] for row in rows()] == list(IMPERFECTIONS_TRIED)
