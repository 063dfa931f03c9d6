"""A campaign that is resumed on another kind of processor goes on: nothing is refused, lost or executed again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_kill import content

from ctxval import Store
from rig_thorough import more

SCRIPT = Path(__file__).parents[1] / ("rig_processor.py")
OLD, NEW = "Nehalem", "Haswell"
"""Processors of 2008 and 2013: the second one multiplies and adds in one rounding."""


def run(search: str, budget: int, processor: str, *stores: Path) -> str:
    """Run campaigns as a processor would; return which kernels were used."""
    done = subprocess.run(
        [sys.executable, str(SCRIPT), search, str(budget), *map(str, stores)],
        env={**os.environ, "OPENBLAS_CORETYPE": processor},
        cwd=SCRIPT.parent,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("search", ["auto", *more("gp-ucb")])
def test_a_campaign_goes_on_upon_another_processor(search: str, tmp_path: Path) -> None:
    moved, unmoved = tmp_path / "moved.sqlite", tmp_path / "unmoved.sqlite"
    kernels = run(search, 3, OLD, moved)
    before = content(moved)
    if run(search, 4, NEW, moved, unmoved) == kernels:
        pytest.skip(f"the linear algebra here has one kind of kernels, {kernels.strip()}")
    after, expected = Store(moved).trials(), Store(unmoved).trials()
    assert content(moved)[:3] == before
    assert [(trial.state, trial.attempts) for trial in after] == [("completed", 1)] * 4
    # Not bit for bit: the kernels round otherwise, from the first trajectory on.
    assert content(moved) != content(unmoved)
    for one, other in zip(after, expected, strict=True):
        assert one.unit_point == pytest.approx(other.unit_point, abs=1e-3)
        assert one.distance == pytest.approx(other.distance, rel=1e-3)
    assert max(t.distance or 0 for t in after) == pytest.approx(max(t.distance or 0 for t in expected), rel=1e-3)
