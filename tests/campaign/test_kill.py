"""``kill -9`` at random moments: what was executed stays, and the resumed campaign ends as the unbroken one."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Store, searches

BUDGET = 8
SCRIPT = Path(__file__).parents[1] / "kill_me.py"


def start(store: Path) -> subprocess.Popen[str]:
    command = [sys.executable, str(SCRIPT), str(store), str(BUDGET)]
    # Its only line is read and the pipe closed: nothing is left to the garbage collector.
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=SCRIPT.parent)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.stdout.close()
    return process


def content(store: Path) -> list[tuple[object, ...]]:
    """Everything that must not depend on when the process was killed."""
    opened = Store(store)
    rows: list[tuple[object, ...]] = []
    for trial in opened.trials():
        sides = [opened.trajectory(trial.number, side) for side in ("model", "system")]
        states = [None if side is None else (side.states.tobytes(), side.inputs.tobytes()) for side in sides]
        rows.append((trial.number, trial.origin, trial.state, trial.unit_point.tobytes(), trial.distance, *states))
    opened.close()
    return rows


def completed(store: Path) -> int:
    """The number of completed trials, read as another process sees them."""
    try:
        with closing(sqlite3.connect(f"file:{store}?mode=ro", uri=True)) as reader:
            return int(reader.execute("SELECT count(*) FROM trials WHERE state = 'completed'").fetchone()[0])
    except sqlite3.OperationalError:  # it is not made yet
        return 0


def resumed(store: Path) -> tuple[list[tuple[object, ...]], list[tuple[object, ...]]]:
    """Resume a campaign that was killed; return what was completed before, and everything afterwards."""
    before = [row for row in content(store) if row[2] == "completed"]
    Campaign(make_validation(), search=searches.GPUCB(), store=store, seed=11, name="killed").run(BUDGET)
    return before, content(store)


@pytest.mark.slow
def test_a_killed_campaign_resumes_bit_for_bit(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    kills = request.config.getoption("--kills")
    whole = tmp_path / "whole.sqlite"
    began = time.perf_counter()
    Campaign(make_validation(), search=searches.GPUCB(), store=whole, seed=11, name="killed").run(BUDGET)
    duration = time.perf_counter() - began
    expected = content(whole)
    rng = np.random.default_rng(2024)
    found_midway = 0
    for number in range(kills):
        store = tmp_path / f"{number}.sqlite"
        process = start(store)
        # At any moment from the first step to the last one, also if another load slows the process down.
        first = int(rng.integers(0, BUDGET - 2))
        while process.poll() is None and completed(store) < first:
            time.sleep(0.001)
        time.sleep(rng.uniform(0, duration / BUDGET))
        process.kill()
        process.wait()
        before, after = resumed(store)
        found_midway += 0 < len(before) < BUDGET
        assert after[: len(before)] == before, "a completed execution was lost or changed"
        assert after == expected
    # Where every kill came before or after the loop, nothing would have been shown.
    assert found_midway >= max(1, kills // 4)
