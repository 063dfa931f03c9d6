"""The page of the parts is what the registries give."""

from __future__ import annotations

import sys
from pathlib import Path

from facts import assert_names

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import parts_page  # noqa: E402


def test_the_page_is_current() -> None:
    assert parts_page.PAGE.read_text() == parts_page.page(), "docs/parts.md is not current; run `make parts`."


def test_it_has_every_part_and_what_it_takes() -> None:
    page = parts_page.page()
    for section in parts_page.SECTIONS:
        for name in section.registry.built_in:
            assert page.count(f"\n| `{name}` |") >= 1
    assert_names(page, "FMU", "FMI", 2, 3)
    assert "`step` (a function `(x, u) -> x_next`)" in page
    assert "`**options`" in page
