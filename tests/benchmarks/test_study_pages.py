"""Pages of studies are what the stored results give, and say with which sources these were measured."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import calibration_page
import compare_page
import search_page
import study_main_job
import study_refine
from page_tables import GeneratedPage
from peers import page as peers_page


@pytest.mark.thorough
def test_the_calibration_is_what_the_stored_campaigns_give() -> None:
    assert calibration_page.page().outdated() == []


@pytest.mark.parametrize("page", [search_page.page, peers_page.page], ids=["searches", "benchmarks"])
def test_a_page_and_its_tables_are_what_the_stored_results_give(page: Callable[[], GeneratedPage]) -> None:
    generated = page()
    assert generated.outdated() == []
    assert "Results measured" in generated.text


@pytest.mark.parametrize(
    ("module", "text"),
    [
        (compare_page, compare_page.page),
        (study_main_job, study_main_job.text),
        (study_refine, study_refine.page),
    ],
    ids=["comparison", "main-job", "refinement"],
)
def test_a_page_is_what_the_stored_results_give(module: Any, text: Callable[[], str]) -> None:
    page = module.PAGE.read_text()
    assert page == text()
    assert "Results measured" in page
