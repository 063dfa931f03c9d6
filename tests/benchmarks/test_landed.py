"""Ratios of CPU times, as benchmarks print and store them and the page on the search shows them."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from facts import assert_names

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import landed  # noqa: E402
import search_speed_part  # noqa: E402
from json_lines import JsonLines  # noqa: E402

RATIO = landed.Ratio("bench_auto", "a suggestion", [3.0, 1.0, 2.0], [0.5, 0.25, 0.25], least=8.0)


def test_a_ratio_is_that_of_medians_and_has_a_spread() -> None:
    assert RATIO.value == 8.0
    assert RATIO.each == [6.0, 4.0, 8.0]
    assert_names(str(RATIO), 2, 0.25, "CPU", 8.0)


@pytest.mark.parametrize(
    ("least", "most", "met"), [(8.0, None, True), (8.1, None, False), (None, 8.0, True), (None, 7.9, False)]
)
def test_a_ratio_is_met_within_its_bounds(least: float | None, most: float | None, met: bool) -> None:
    assert landed.Ratio("b", "f", [8.0], [1.0], least, most).met is met


def test_a_ratio_is_stored_only_if_this_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = JsonLines(tmp_path / "speed.jsonl", landed.STORED.key)
    monkeypatch.setattr(landed, "STORED", stored)
    RATIO.tell(store=False)
    assert not len(stored)
    RATIO.tell(store=True)
    assert landed.Ratio(**stored["bench_auto", "a suggestion"]) == RATIO


def test_the_page_shows_ratios_and_whether_they_are_what_was_asked() -> None:
    assert search_speed_part.cells(RATIO) == ["a suggestion", "2", "0.25", "8.0 (4.0 to 8.0)", "at least 8", "yes"]
    alone = landed.Ratio("bench_designs", "a design", [2.0], [1.0])
    assert search_speed_part.cells(alone) == ["a design", "2", "1", "2.0", "-", "-"]


def test_all_stored_ratios_are_of_benchmarks_that_exist() -> None:
    for record in landed.STORED.values():
        one = landed.Ratio(**record)
        assert asdict(one) == record
        assert (BENCHMARKS / f"{one.benchmark}.py").exists()
