"""What each diagnostic caught, in campaigns whose thresholds are below d*."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from rig_evidence import GOOD, prediction
from strangers_diagnostics import FAILED, JudgedRun, caught, stopping

UNTESTED = "largest distance untested"


def test_nothing_is_stopped_that_is_not_below_the_threshold() -> None:
    assert stopping(GOOD, 0.8, 2.0) == []
    assert stopping(GOOD, 0.8, 0.9) is None
    assert stopping(replace(GOOD, executions=1), 2.5, 2.0) is None


def test_a_failed_prediction_stops_what_its_raised_bound_exceeds() -> None:
    failing = replace(GOOD, predictions=(*GOOD.predictions, prediction(4, 0.5, 0.6)))
    assert stopping(failing, 0.8, 2.0) == [FAILED]
    assert FAILED not in (stopping(failing, 0.8, 9.0) or [])


class Judged:
    """Dynamics that are judged once in each of a few executions."""

    def screening(self, trials: list[Any], *, pending: bool = False) -> Any:
        return replace(GOOD, executions=len(trials))

    evidence = kept_evidence = screening


def test_the_last_judgement_after_each_execution_counts() -> None:
    dynamics, trials = Judged(), list[Any]()

    def run(budget: int, threshold: float) -> None:
        for _ in range(budget):
            campaign.executions = len(trials)
            judge: Callable[..., Any] = dynamics.screening
            judge(trials, pending=True)
            judge(trials)
            trials.append(SimpleNamespace(distance=0.5))

    campaign: Any = SimpleNamespace(recorder=SimpleNamespace(dynamics=dynamics), executions=0, run=run)
    assert JudgedRun(campaign, 2.0).run(5) == [
        [0, ["fewest executions", UNTESTED]],
        [1, ["fewest executions", UNTESTED]],
        [2, ["fewest executions", UNTESTED]],
        [3, [UNTESTED]],
        [4, [UNTESTED]],
    ]
    assert not vars(dynamics)  # nothing is watched any more


def test_a_diagnostic_that_alone_stops_a_step_is_counted_once_for_its_campaign() -> None:
    rows = caught([{"stopped": [[1, ["gap", "noise"]], [2, ["gap"]], [3, ["gap"]], [4, []]]}, {"stopped": []}])
    assert rows[0] == ["gap", "3", "2", "1"]
    assert rows[1] == ["noise", "1", "0", "0"]
    assert all(row[1:] == ["0", "0", "0"] for row in rows[2:])
