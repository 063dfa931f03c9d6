"""The examples run as a reader runs them, and print what they promise."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from rig_thorough import more

FIRST = "1_first_verdict"  # the Python of the README does the same
SHORTEST = "4_own_distance_and_search"
LONGEST = ("6_replay_logs", "7_from_logs_to_a_validated_model")
EXAMPLES = Path(__file__).parents[1] / "examples"
PRINTED = {
    "1_first_verdict": [
        "11 executions of the cart",
        "falsified: trial",
        "validated: every task",
    ],
    "2_resume_and_inspect": ["Tuesday: 6 executions are stored.", "Tuesday: 15 executions", "The worst task"],
    "3_hardware_by_hand": [
        "Trial 0: load 2.00 kg, go to 1.00 m ... failed: the fuse has blown.",
        "Trial 7",
        "falsified",
    ],
    "4_own_distance_and_search": ["The search keeps the contract.", "more than promised #", "Worst goal: 1.2"],
    "6_replay_logs": [
        "8 recordings; the model was learned from 1 of them.",
        "add 0.04 to delay in the mapping of the recordings",
        "With the delay, the one-step error of the rate falls from 0.107 to 0.003 rad/s.",
    ],
    "7_from_logs_to_a_validated_model": [
        "Three executions: falsified: trial",
        "the model of round 1 is validated",
        "executions under its own controllers; 3 executions under controllers of other models",
        "all records",
        "Report: boat.html",
    ],
    "5_audit_and_retrain": ["the largest gap in 59 random tasks is 0.3 m.", "is 0.015 m.", "What this rests on:"],
}


def test_every_example_is_executed() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(PRINTED)


@pytest.mark.parametrize("name", PRINTED)
def test_an_example_fits_on_a_page(name: str) -> None:
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) < 60


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [*(name for name in PRINTED if name not in (FIRST, SHORTEST, *LONGEST)), *more(FIRST, SHORTEST, *LONGEST)]
)
def test_an_example_prints_what_it_promises_and_leaves_nothing_behind(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    printed = capsys.readouterr().out
    for sentence in PRINTED[name]:
        assert sentence in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("name", [SHORTEST, *more(*(name for name in PRINTED if name != SHORTEST))])
def test_an_example_runs_as_a_reader_runs_it(name: str, tmp_path: Path) -> None:
    """In a process of its own, with as many draws and closed loops as the reader's."""
    command = [sys.executable, "-W", "error", str(EXAMPLES / f"{name}.py")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for sentence in PRINTED[name]:
        assert sentence in done.stdout
    assert not list(tmp_path.iterdir())
