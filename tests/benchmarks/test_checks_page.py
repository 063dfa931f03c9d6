"""The documentation has the checks of the gate."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import checks_page
from ctxval.certificates.checks import CHECKS


def test_the_table_is_current() -> None:
    assert checks_page.TABLE.read_text(encoding="utf-8") == checks_page.table(), "run `make parts`."
    assert all(f"`{check.code}`," in checks_page.table() for check in CHECKS)
