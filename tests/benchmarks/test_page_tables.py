"""Generated pages: their lines are filled, and a page or a table that differs from the results is named."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import page_tables
from page_tables import GeneratedPage, csv_text, interval, reflowed, share_of, table

TABLE = (["a", "b"], [["1", "x, y"]])


def test_a_table_is_markdown_or_csv() -> None:
    assert table(*TABLE) == "| a | b |\n|---|---|\n| 1 | x, y |"
    assert csv_text(TABLE) == 'a,b\n1,"x, y"\n'


def test_paragraphs_and_lists_are_filled_and_other_blocks_stay() -> None:
    words = " ".join(["word"] * 40)
    text = f"# {words}\n\n{words}\n\n- {words}\n- two\n\n| {words} |\n\n```console\n$ {words}\n```\n\n`a` b\nc\n"
    lines = reflowed(text).splitlines()
    assert [line for line in lines if len(line) > 120] == [f"# {words}", f"| {words} |", f"$ {words}"]
    assert lines[6].startswith("  word")
    assert lines[-1] == "`a` b c"
    assert reflowed(reflowed(text)) == reflowed(text)


def test_what_differs_from_the_results_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_tables, "DOCS", tmp_path)
    page = GeneratedPage("page.md", "[table](tables/one.csv)\n", {"one": TABLE})
    assert page.outdated() == ["page.md", "one.csv"]
    page.write()
    assert page.outdated() == []
    assert GeneratedPage("page.md", "no link", {"one": TABLE}).outdated() == ["page.md", "one"]


def test_a_share_has_its_upper_limit() -> None:
    low, high = interval(0, 100)
    assert (low, high) == pytest.approx((96.38, 100.0), abs=0.01)
    assert share_of(0, 100) == "0 of 100 (0 %, at most 3.6 %)"
    assert share_of(0, 0) == "-"
