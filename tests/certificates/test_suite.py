"""The certificate of a suite of which all tasks were executed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval.certificates import (
    Audit,
    Automatic,
    CertificateOptions,
    DistanceBound,
    Dynamics,
    Provenance,
    Sample,
    WholeSuite,
    judge,
)
from ctxval.core.task_suite import TaskSuite
from ctxval.core.trial import State, Trial
from ctxval.errors import CertificateError
from facts import assert_names, refuses

SUITE = TaskSuite({f"run {k}": {"size": float(k)} for k in range(4)})
KNOWN = Provenance(space=SUITE)


def trial(number: int, distance: float | None) -> Trial:
    state: State = "failed" if distance is None else "completed"
    task = {"task": SUITE.task_names[number]}
    return Trial(number, "acquisition", state, SUITE.members[number], task, 1, True, distance)


def trials(*distances: float | None) -> list[Trial]:
    return [trial(*numbered) for numbered in enumerate(distances)]


def test_all_executed_tasks_bound_the_largest_distance_exactly() -> None:
    done = trials(0.1, 0.4, 0.2, 0.3)
    certificate = WholeSuite().certify(replace(Sample.of(done), suite=SUITE.members))
    assert (certificate.upper_bound, certificate.volume, certificate.error) == (0.4, 0.0, 0.0)
    assert "All 4 tasks" in certificate.statement
    for kind in (Automatic(), WholeSuite()):
        verdict = judge(done, 0.4, CertificateOptions(kind), KNOWN)
        assert verdict.answer == "validated"
        assert verdict.bound == 0.4
        assert_names(str(verdict), 4, "suite")


@pytest.mark.parametrize("distances", [(0.1, 0.4, 0.2), (0.1, 0.4, None, 0.2), (0.1,)])
def test_a_task_without_a_distance_leaves_it_undecided(distances: tuple[float | None, ...]) -> None:
    for kind in (Automatic(), WholeSuite()):
        verdict = judge(trials(*distances), 0.5, CertificateOptions(kind), KNOWN)
        assert verdict.answer == "undecided"
        assert verdict.certificate is None
        missing = 4 - sum(d is not None for d in distances)
        assert_names(verdict.reason, 4, missing)


def test_one_execution_above_the_threshold_falsifies_also_if_it_was_predicted_to_be_noisy() -> None:
    verdict = judge(trials(0.1, 0.6), 0.5, None, KNOWN)
    assert verdict.answer == "falsified"
    assert "task 'run 1'" in verdict.reason


@pytest.mark.parametrize("kind", [DistanceBound(), Audit()])
def test_other_kinds_are_refused(kind: DistanceBound | Audit) -> None:
    verdict = judge(trials(0.1, 0.2, 0.3, 0.4), 0.5, CertificateOptions(kind), KNOWN)
    assert verdict.answer == "undecided"


def test_a_box_cannot_be_executed_as_a_whole() -> None:
    sample = Sample(np.array([[0.0], [1.0]]), np.ones(2), ["acquisition"] * 2, ["completed"] * 2)
    with refuses(CertificateError, "suite"):
        WholeSuite().certify(sample)
    assert sample.not_executed is None
    assert sample.tasks is None
    assert sample.is_uniform


def test_kinds_for_suites_say_so() -> None:
    assert all(kind.takes_suites for kind in (Automatic, Dynamics, WholeSuite))
    assert not DistanceBound.takes_suites
