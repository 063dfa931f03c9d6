"""The page on replay states the times that were measured."""

from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_page_states_the_measured_times() -> None:
    found = json.loads((ROOT / "benchmarks" / "results" / "replay.json").read_text())
    page = (ROOT / "docs" / "how-to" / "replay.md").read_text()
    assert set(found) == {"install", "mcap", "mat", "lerobot"}
    for times in found.values():
        assert f"| {times['cpu']} s |" in page
        assert f"{times['wall']} s" not in page  # it depends on what else the computer did
