"""Comparisons on suites of tasks."""

from __future__ import annotations

import pytest

from ctxval import compare
from ctxval.errors import InputError
from rig_suites import COARSE, validation


def test_a_comparison_is_decided_when_all_tasks_were_executed() -> None:
    candidates = {"little": validation(drag=0.3), "much": validation(drag=0.33)}
    truths = {name: each.distances(COARSE.grid(2)).max() for name, each in candidates.items()}
    found = compare(candidates, budget=50)
    assert found.questions == ("worst",)
    assert found.decided
    assert found.pairs[0].smaller == min(truths, key=lambda name: truths[name])
    assert all(result.executions <= len(COARSE) for result in found.candidates)


def test_candidates_that_are_equal_are_not_told_apart_by_a_suite() -> None:
    found = compare({"one": validation(), "other": validation()}, budget=50)
    assert not found.decided
    assert found.executions == len(COARSE)  # one execution counts for both


def test_a_suite_has_no_expected_distance() -> None:
    with pytest.raises(InputError, match="question must be worst for a suite"):
        compare({"one": validation(), "other": validation(drag=0.1)}, question="mean")
