from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval import Trial
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.certificates.stopping import StoppingRule
from ctxval.certificates.verdict import judge
from facts import assert_names

pytestmark = pytest.mark.usefixtures("few_draws")


def trial(number: int, x: float, distance: float) -> Trial:
    return Trial(number, "acquisition", "completed", np.array([x]), {"x": x}, 1, True, distance)


def test_a_corner_that_a_trial_is_only_near_to_is_executed_before_anything_is_validated() -> None:
    known = [trial(k, x, 0.1 * np.sin(3 * x)) for k, x in enumerate(np.linspace(0.0, 0.95, 9).tolist())]
    now = StoppingRule(0.9).decide(known, left=5)
    assert not now.decided
    assert now.next_point is not None
    assert now.next_point.tolist() == [1.0]
    by_distance = CertificateOptions(DistanceBound())
    verdict = judge(known, 0.9, by_distance)
    assert verdict.answer == "undecided"
    assert_names(verdict.reason, 1, 2)
    # What rises towards the end, and nowhere else, is found there.
    assert StoppingRule(0.9).decide([*known, trial(9, 1.0, 1.0)], left=4).decided
    assert judge([*known, trial(9, 1.0, 1.0)], 0.9).answer == "falsified"
    assert judge([*known, trial(9, 1.0, 0.01)], 0.9, by_distance).answer == "validated"


@pytest.mark.thorough
def test_corners_of_two_parameters_come_first() -> None:
    points = [[0.5, 0.5], [0.05, 0.05], [0.95, 0.0], [0.0, 0.95], [0.5, 0.0], [0.0, 0.5]]
    known = [replace(trial(k, 0.0, 0.1 * k), unit_point=np.array(point)) for k, point in enumerate(points)]
    asked = []
    while len(known) < 10:
        now = StoppingRule(1e3).decide(known, left=60)
        assert now.next_point is not None
        asked.append(now.next_point.tolist())
        known.append(replace(trial(len(known), 0.0, 0.3), unit_point=now.next_point))
    assert sorted(asked) == [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]


@pytest.mark.slow
def test_a_bound_is_put_to_the_test_twice_before_it_decides() -> None:
    known = [trial(k, x, 0.5 + 0.3 * np.sin(9 * x)) for k, x in enumerate([0.0, 0.2, 0.42, 0.6, 0.8, 1.0])]
    for _ in range(2):
        now = StoppingRule(50.0).decide(known, left=5)
        assert not now.decided
        assert now.next_point is not None
        x = float(now.next_point[0])
        assert min(abs(x - one.unit_point[0]) for one in known) > 0.01
        known.append(trial(len(known), x, 0.5 + 0.3 * np.sin(9 * x)))
    assert StoppingRule(50.0).decide(known, left=3).decided
    # Without a budget for that, the verdict is what the bound makes it.
    assert StoppingRule(50.0).decide(known[:-1], left=0).decided
    # A test that lifts the bound above the threshold leaves it undecided.
    lifted = [*known[:-1], replace(known[-1], distance=49.0)]
    now = StoppingRule(50.0).decide(lifted, left=3)
    assert not now.decided


@pytest.mark.thorough
def test_a_study_can_vary_how_often_a_bound_is_put_to_the_test() -> None:
    known = [trial(k, x, 0.5 + 0.3 * np.sin(9 * x)) for k, x in enumerate([0.0, 0.2, 0.42, 0.6, 0.8, 1.0])]
    assert not StoppingRule(50.0).decide(known, left=5).decided
    assert StoppingRule(50.0, confirmations=0).decide(known, left=5).decided


def test_screening_alone_keeps_a_bound_from_being_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    known = [trial(k, x, 0.5 + 0.3 * np.sin(9 * x)) for k, x in enumerate([0.0, 0.2, 0.42, 0.6, 0.8, 1.0])]
    monkeypatch.setattr("ctxval.certificates.stopping._SCREENINGS", ((8, -1.0),))
    never = StoppingRule(50.0, confirmations=0)
    assert not never.decide(known, left=5).decided
