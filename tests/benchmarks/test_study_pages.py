"""Pages of studies are what the stored results give, and say with which sources these were measured."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import calibration_page
import compare_page
import search_page
import servo_page
import study_envelope
import study_friction
import study_main_job
import study_refine
import study_simulated_robots
from peers import page as peers_page


@pytest.mark.thorough
def test_the_calibration_is_what_the_stored_campaigns_give() -> None:
    assert calibration_page.page().outdated() == []


STUDIES = {
    "comparison": compare_page.page,
    "searches": search_page.page,
    "main-job": study_main_job.page,
    "refinement": study_refine.page,
    "benchmarks": peers_page.page,
}
OTHERS = {
    "servo": servo_page.page,
    "envelope": study_envelope.page,
    "dry-friction": study_friction.page,
    "simulated-robots": study_simulated_robots.page,
}
"""Pages that do not say with which sources their results were measured."""


@pytest.mark.parametrize("name", [*STUDIES, *OTHERS])
def test_a_page_and_its_tables_are_what_the_stored_results_give(name: str) -> None:
    page = {**STUDIES, **OTHERS}[name]()
    assert page.outdated() == []
    assert ("Results measured" in page.text) == (name in STUDIES)
