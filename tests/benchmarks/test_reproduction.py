"""The page on the paper's experiments is what the stored runs give, and these are of the cases as they are."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from reproduce import FULL, STUDIES, parameters, table_text
from reproduce.jobs import Results

RESULTS = Path("benchmarks/results/reproduce")
"""Seen from the folder of the repository, as the page names it."""


@pytest.fixture(autouse=True)
def repository(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])


def test_no_stored_run_is_missing_or_outdated() -> None:
    stored = Results(RESULTS)
    assert [job.key for study in STUDIES for job in study.jobs(FULL) if job not in stored] == []


@pytest.mark.slow
@pytest.mark.thorough
def test_the_page_is_what_the_stored_runs_give() -> None:
    page = table_text(Path("docs/reproduction"), STUDIES, Results(RESULTS), FULL)
    assert Path("docs/reproduction.md").read_text() == page
    rows = list(csv.reader(Path("docs/reproduction/parameters.csv").read_text().splitlines()))
    assert rows == [list(row) for row in parameters(STUDIES)]
