"""The envelope: one factor for all tasks together, raised by tests, and what it does not trust."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import TaskSpace, TaskSuite
from ctxval.certificates import CheckedPrediction, Evidence
from ctxval.certificates.drawn_distances import DrawnDistances
from ctxval.certificates.envelope import (
    Envelope,
    boundary_tasks,
    doubt_of_envelope,
    envelope_of,
    must_outlive_a_test,
    withdrawn,
)
from ctxval.certificates.sentences.statements import IRREGULAR
from ctxval.core.target import Quantile
from ctxval.errors import CertificateError, InputError
from facts import assert_names, refuses
from rig_evidence import GOOD

SPACE = TaskSpace(goal=(-2.0, 2.0, "m"), load=(0.0, 4.0, "kg"))


def drawn_from(points: np.ndarray, draws: int = 40, size: float = 0.05, seed: int = 0) -> DrawnDistances:
    """Draws of a distance that grows with the load, with smooth errors of this size."""
    rng = np.random.default_rng(seed)
    phases, frequencies = rng.uniform(0, 6, (draws, 3)), rng.uniform(1, 4, (draws, 3, 2))
    waves = np.sin(np.einsum("skd,nd->snk", frequencies, points) + phases[:, None]).mean(axis=2)
    return DrawnDistances(points, points[:, 1] + size * waves, *np.zeros((2, len(points))))


def evidence_of(**changes: Any) -> Evidence:
    tests = tuple(
        CheckedPrediction(k, 0.5, 0.4, 0.42, 0.4, origin="spread", point=(k / 9, 0.4), explained=0.4)
        for k in range(2, 10)
    )
    return replace(GOOD, predictions=tests, tests=8, executions=10, **changes)


POINTS = np.random.default_rng(3).random((250, 2))
EXECUTED = [(np.array([0.5, 0.9]), 0.9)]


def envelope(evidence: Evidence | None = None, **changes: Any) -> Envelope:
    drawn = replace(drawn_from(POINTS), **changes)
    return envelope_of(SPACE, drawn, evidence or evidence_of(), EXECUTED, 0.6, 0.95)


@functools.cache
def usual_envelope() -> Envelope:
    return envelope()


def test_the_factor_holds_for_all_tasks_of_a_further_draw() -> None:
    held = 0
    for seed in range(300):
        drawn = drawn_from(POINTS[:60], draws=41, seed=seed)
        some = replace(drawn, draws=drawn.draws[:40])
        k = some.factor(0.6, 0.9)
        held += bool((drawn.draws[40] <= some.mean + k * some.spread(0.6) + 1e-12).all())
    assert 0.86 <= held / 300 <= 0.97  # 0.9 and a little more, because the rank is rounded up


def test_a_confidence_that_needs_more_draws_is_refused() -> None:
    with refuses(CertificateError, 0.99, 40):
        drawn_from(POINTS).factor(0.6, 0.99)


def test_tasks_below_the_threshold_are_trusted_in_their_own_units() -> None:
    found = usual_envelope()
    assert found.doubt is None
    loads = np.array([0.2, 1.5, 2.0, 2.8, 3.9])
    tasks = np.stack([np.linspace(-1.5, 1.5, 5), loads], axis=1)
    np.testing.assert_array_equal(found.trusted(tasks), loads < 2.1)
    assert found.trusted({"goal": 0.3, "load": 1.0}) is np.True_
    bounds = found.bound(tasks[:3])
    assert (bounds >= loads[:3] / 4).all()
    assert (bounds <= 0.6).all()
    assert found.bound([0.0, 3.9]) == np.inf
    assert not found.trusted([[-2.1, 0.1], [0.0, -0.1]]).any()  # no tasks of the space
    assert 0.4 < found.share < 0.6
    assert found.regions[0].text.startswith("load below 2.")
    assert "95 % confidence" in found.statement


def test_an_executed_excess_is_never_trusted() -> None:
    point = np.array([0.31, 0.2])
    executed = [*EXECUTED, (point, 0.601)]
    found = envelope_of(SPACE, drawn_from(POINTS), evidence_of(), executed, 0.6, 0.95)
    assert not found.trusted(SPACE.from_unit(point))
    assert usual_envelope().trusted(SPACE.from_unit(point))


def test_tasks_that_leave_the_records_or_cannot_be_planned_are_not_trusted() -> None:
    beyond = np.where(POINTS[:, 0] > 0.5, 0.1, 0.0)
    draws = np.where(POINTS[:, 0] < 0.2, np.nan, drawn_from(POINTS).draws)
    found = envelope(beyond=beyond, draws=draws)
    low = np.column_stack([np.linspace(0.02, 0.98, 25), np.full(25, 0.1)])
    trusted = np.isfinite(found.bound_at(low))
    assert trusted.any()
    assert (low[trusted, 0] < 0.52).all()
    assert (low[trusted, 0] > 0.2).all()
    assert 0.25 < found.uncovered < 0.33
    assert usual_envelope().uncovered == 0


def test_a_test_that_exceeds_its_prediction_raises_the_factor() -> None:
    usual, evidence = usual_envelope(), evidence_of()
    worse = replace(evidence.predictions[3], distance=0.48)
    predictions = (*evidence.predictions[:3], worse, *evidence.predictions[4:])
    raised = envelope(replace(evidence, predictions=predictions))
    assert usual.raised_by is None
    assert raised.raised_by == worse.trial
    # Its excess is a fifth of its own distance of 0.4, so it is taken for as large a share of the threshold of 0.6.
    assert raised.factor == pytest.approx(0.6 / 0.4 * 0.08 / (0.02 / 1.645))
    assert raised.share < usual.share
    drawn = drawn_from(POINTS)
    assert must_outlive_a_test(drawn, replace(evidence, predictions=predictions), 0.6)
    assert not must_outlive_a_test(drawn, evidence, 0.6)
    # Nothing is claimed of a task far above the threshold.
    far = replace(worse, median=0.8, upper=0.81, distance=0.95, explained=0.95)
    assert envelope(replace(evidence, predictions=(*predictions[:3], far, *predictions[4:]))).raised_by is None


@pytest.mark.parametrize("sign", [-1, 1])
def test_distances_that_the_draws_do_not_have_raise_the_factor(sign: int) -> None:
    drawn, evidence = drawn_from(POINTS), evidence_of()
    row = int(np.abs(drawn.mean - 0.3).argmin())
    distance = drawn.mean[row] + sign * 7 * drawn.spread(0.6)[row]
    test = CheckedPrediction(11, 0.5, distance, 2.0, distance, origin="spread", point=tuple(POINTS[row]), explained=0.3)
    missed = replace(evidence, predictions=(*evidence.predictions, test))
    raised = envelope_of(SPACE, drawn, missed, EXECUTED, 0.6, 0.95)
    assert raised.factor == pytest.approx(7)
    assert raised.raised_by == 11
    assert raised.share < usual_envelope().share
    above = replace(test, point=tuple(POINTS[int(drawn.mean.argmax())]))  # nothing is claimed of this task
    known = envelope_of(SPACE, drawn, replace(evidence, predictions=(above,)), EXECUTED, 0.6, 0.95)
    assert known.raised_by is None
    noisy = replace(missed, target=Quantile(0.9))  # noise explains it
    assert envelope_of(SPACE, drawn, noisy, EXECUTED, 0.6, 0.95).raised_by is None


def test_what_withdraws_it() -> None:
    evidence = evidence_of()
    assert doubt_of_envelope(evidence, 0.6) is None
    few = replace(evidence, predictions=evidence.predictions[:6])
    assert_names(str(doubt_of_envelope(few, 0.6)), 2, "executions")
    moved = replace(evidence.predictions[0], explained=0.5)
    other = replace(evidence, predictions=(moved, *evidence.predictions[1:]))
    assert doubt_of_envelope(other, 0.6) is None
    above = replace(evidence.predictions[0], distance=0.62, explained=0.5)
    other = replace(evidence, predictions=(above, *evidence.predictions[1:]))
    assert_names(str(doubt_of_envelope(other, 0.6)), 2, "distance", 0.62, 0.5)
    assert "at least 3" in str(doubt_of_envelope(replace(evidence, executions=2), 0.6))
    assert doubt_of_envelope(replace(evidence, unplanned=0.3), 0.6) is None
    none = withdrawn(SPACE, 0.6, 0.95, "too little is known.")
    assert not none.trusted(np.zeros((3, 2))).any()


def test_an_envelope_without_tasks_says_so(tmp_path: Path) -> None:
    found = envelope(draws=drawn_from(POINTS).draws + 2)
    assert found.share == 0
    assert_names(found.words, "task")
    with refuses(InputError, "task"):
        withdrawn(SPACE, 0.6, 0.95, "why").save(tmp_path / "e.py")


def test_the_exported_function_is_the_same_and_needs_numpy_alone(tmp_path: Path) -> None:
    found = envelope(beyond=np.where(POINTS[:, 0] > 0.9, 0.1, 0.0))
    source = found.save(tmp_path / "folder" / "envelope.py").read_text()
    assert "ctxval" not in source.split("import base64", 1)[1]
    names: dict[str, Any] = {}
    exec(compile(source, "envelope.py", "exec"), names)
    tasks = SPACE.from_unit(np.random.default_rng(4).uniform(0, 1, (3, 500, 2)))
    trusted, bounds = names["trusted"](tasks)
    np.testing.assert_array_equal(trusted, found.trusted(tasks))
    np.testing.assert_array_equal(bounds, found.bound(tasks))
    one, bound = names["trusted"]([0.0, 1.0])
    assert one
    assert bound < 0.6
    assert names["trusted"]([-2.5, 1.0]) == (False, np.inf)
    with refuses(ValueError, "goal", "load"):
        names["trusted"]([1.0])
    for known, name in ((found, "e.txt"), (found, "e.onnx"), (withdrawn(SPACE, 0.6, 0.95, "why"), "e.py")):
        with pytest.raises(InputError):
            known.save(name)


def test_boundary_tasks_lie_next_to_the_boundary() -> None:
    candidates = np.random.default_rng(6).random((2000, 2))
    near = boundary_tasks(drawn_from(POINTS), evidence_of(), 0.6, 0.95, candidates, 30)
    assert 5 < len(near) <= 30
    assert (np.abs(near[:, 1] - 0.53) < 0.1).all()


def test_of_a_suite_it_is_a_list_and_executed_tasks_are_facts() -> None:
    suite = TaskSuite({name: {"load": load} for name, load in zip("abcde", (0.0, 0.3, 0.5, 0.9, 1.0), strict=True)})
    points = suite.members
    draws = np.tile(points[:, 0], (40, 1)) + 0.01 * np.random.default_rng(0).normal(size=(40, 1))
    executed = [(points[0], 0.7), (points[3], 0.55)]  # nothing is predicted of these
    found = envelope_of(
        suite, DrawnDistances(points, draws, np.zeros(5), np.zeros(5)), evidence_of(), executed, 0.6, 0.95
    )
    assert found.tasks == ("b", "c", "d")
    assert found.words == "Trusted: b, c, d."
    assert found.share == pytest.approx(0.6)
    assert found.trusted({"task": "b"})
    assert not found.trusted({"task": "a"})
    assert found.bound({"task": "d"}) == 0.55
    far = DrawnDistances(points, draws, np.ones(5), np.zeros(5))
    known = envelope_of(suite, far, evidence_of(), executed, 0.6, 0.95)
    assert known.tasks == ("d",)
    assert known.uncovered == pytest.approx(0.4)  # b and c: a was executed
    assert "no further task" not in known.statement


@pytest.mark.slow
def test_further_tasks_check_what_is_interpolated() -> None:
    def waves(points: np.ndarray) -> DrawnDistances:
        heights = 0.4 + 0.3 * np.sin(25 * points[:, 0]) * np.sin(25 * points[:, 1])
        return DrawnDistances(points, np.tile(heights, (40, 1)), *np.zeros((2, len(points))))

    others = np.random.default_rng(8).random((3000, 2))
    tasks, true = SPACE.from_unit(others), waves(others).mean <= 0.6
    false = []
    for evaluate in (None, waves):
        known = envelope_of(SPACE, waves(POINTS), evidence_of(), [], 0.6, 0.95, evaluate, 200, "m")
        assert_names(known.statement, 0.6, "m", "all", "tasks")
        assert ("no further task checks this" in known.statement) == (evaluate is None)
        assert (known.checks > 0) == (evaluate is not None)
        trusted = known.trusted(tasks, interpolated=True)
        assert known.interpolated == pytest.approx(trusted.mean(), abs=0.03)
        false.append((trusted & ~true).mean())
    assert false[0] > 0.01
    assert false[1] < 0.5 * false[0]
    # The loops of tasks that are asked about are run: nothing between them is lost, or trusted falsely.
    assert trusted[true].mean() < 0.7
    assert (known.trusted(tasks) == (waves(others).upper(known.factor or 0, 0.6) <= 1)).all()
    assert known.share == pytest.approx(known.trusted(tasks).mean(), abs=0.05)
    assert not known.trusted([[2.1, 1.0], [0.0, -0.1]]).any()


def test_draws_that_contradict_an_execution_are_asked_about_no_task() -> None:
    executed = [(np.array([0.5, 0.3]), 0.9)]  # the draws have 0.3 there
    known = envelope_of(SPACE, drawn_from(POINTS), evidence_of(), executed, 0.6, 0.95, drawn_from, 200)
    assert not known.trusted(SPACE.from_unit(executed[0][0]))
    assert known.trusted(SPACE.from_unit(np.array([0.5, 0.1])))
    assert known.share == known.interpolated


def test_tasks_whose_runs_come_to_places_that_no_execution_entered_are_not_trusted() -> None:
    drawn = replace(drawn_from(POINTS), away=2 * POINTS[:, 0])  # more than 1 beyond the middle
    found = envelope_of(SPACE, drawn, evidence_of(), EXECUTED, 0.6, 0.95)
    low = np.column_stack([np.linspace(0.02, 0.98, 25), np.full(25, 0.1)])
    assert (np.isfinite(found.bound_at(low)) == (low[:, 0] < 0.5)).mean() > 0.9
    assert found.uncovered > 0.1


def test_tasks_whose_runs_come_to_contacts_are_not_trusted() -> None:
    drawn = replace(drawn_from(POINTS), crossed=0.2 * (POINTS[:, 0] - 0.5))
    found = envelope_of(SPACE, drawn, evidence_of(), EXECUTED, 0.6, 0.95, irregular=7)
    low = np.column_stack([np.linspace(0.02, 0.98, 25), np.full(25, 0.1)])
    trusted = np.isfinite(found.bound_at(low))
    assert (trusted == (low[:, 0] < 0.5)).mean() > 0.9
    assert not trusted[low[:, 0] > 0.52].any()
    assert found.uncovered > 0.2
    assert found.to_json()["irregular"] == 7
    assert IRREGULAR in found.assumptions
    assert_names(found.statement, 7)
    assert "come to contacts" not in usual_envelope().statement
