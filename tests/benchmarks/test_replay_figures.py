"""The page on replay states the times that were measured."""

from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_page_states_the_measured_times() -> None:
    found = json.loads((ROOT / "benchmarks" / "results" / "replay.json").read_text())
    page = (ROOT / "docs" / "how-to" / "replay.md").read_text()
    assert set(found) == {"install", "mcap", "mat", "lerobot"}
    times = [each["cpu"] for name, each in found.items() if name != "install"]
    assert f"{min(times):.1f} to {max(times):.1f} s of processor time" in page
    assert f"eight recordings with {found['mcap']['steps']} steps" in page
