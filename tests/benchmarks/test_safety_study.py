"""The study of safety: its systems are what they say, and its page is that of the stored results."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import safety_page
import study_safety
from rig_thorough import some
from safety_systems import SYSTEMS, WALL_D_A, WALL_D_B


@pytest.mark.parametrize("name", some(SYSTEMS))
def test_some_tasks_are_safe_and_some_are_not_although_the_model_satisfies_them(name: str) -> None:
    validation = SYSTEMS[name](None)
    points = validation.space.iid(4000, np.random.default_rng(5))
    of_model, of_system, moved = study_safety.robustness(validation, points)
    assert 0.3 < (of_model > 0).mean() < 0.99
    assert ((of_model > 0) & (of_system > 0)).mean() > 0.2
    assert (np.abs(of_model - of_system) <= moved + 1e-9).all()


def test_the_wall_has_its_closed_form() -> None:
    validation = SYSTEMS["wall"](None)
    of_model, of_system, moved = study_safety.robustness(validation, validation.space.grid(101))
    assert moved.max() == pytest.approx(WALL_D_A)
    assert of_model[(of_model > 0) & (of_system <= 0)].max() == pytest.approx(WALL_D_B, abs=0.02)


def test_a_random_system_of_the_study() -> None:
    found = study_safety.linear(3)
    assert found["ordered"]
    assert found["included"]


def test_the_page_is_that_of_the_stored_results() -> None:
    text = safety_page.PAGE.read_text()
    assert text.partition(safety_page.MARK)[2].strip() == safety_page.section().strip()
