"""What withdraws the bound from learned dynamics, from evidence in plain numbers."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from ctxval.certificates import CheckedPrediction, DynamicsEvidence, UnsampledCorner, UnsampledParameter
from ctxval.certificates.dynamics_diagnostics import (
    ACCURATE,
    AGREE,
    BEYOND,
    CORNER,
    DIVERGED,
    FEWEST,
    GAP,
    JUMP,
    LEFT_OUT,
    MATTERS,
    NOISE,
    PAIR_GAP,
    SHARP,
    TESTED,
    doubt_of,
    failed,
    fewest_missing,
    missing_tests,
    only_a_failed_test,
    only_tests_missing,
    raised,
    uncovered,
    untested,
)
from ctxval.core.trial import Origin
from rig_evidence import COVERED, GOOD, gap, prediction

BEST, BOUND = 0.8, 1.0


def doubt(evidence: DynamicsEvidence = GOOD, **changed: Any) -> str | None:
    return doubt_of(replace(evidence, **changed), BEST, BOUND)


TESTS = tuple(replace(prediction(k + 3), origin="spread", point=(k / 9, 1 - k / 9)) for k in range(1, 9))
BAD: list[tuple[dict[str, Any], str]] = [
    ({"executions": FEWEST - 1}, "needs at least 3"),
    ({"unplanned": 0.01}, "for 1 % of the tasks no controller can be designed"),
    ({"predictions": GOOD.predictions[:2]}, "2 executions of different tasks were predicted"),
    ({"noise": 2 * NOISE}, "2 % of the variance of the residual"),
    ({"left_out": 1.1 * LEFT_OUT}, "lack 55 % of the largest posterior variance"),
    (
        {"coverage": replace(COVERED, beyond=gap(2 * BEYOND))},
        "leave the recorded range of u[0] by 4 % (at x[0] 1, u[0] 3)",
    ),
    ({"coverage": replace(COVERED, beyond=gap(2 * DIVERGED))}, "predicted runs diverge"),
    ({"coverage": replace(COVERED, marginal=gap(1.1 * GAP))}, "enter a gap in the records of u[0] by 28 %"),
    (
        {"coverage": replace(COVERED, pair=gap(1.1 * PAIR_GAP, "x[0]", "u[0]"))},
        "enter a gap in the joint records of x[0] and u[0] by 55 % (at x[0] 1, u[0] 3)",
    ),
    ({"unsampled_parameter": UnsampledParameter("load", 1.1 * GAP, np.zeros(2))}, "the parameter load hardly changes"),
    (
        {"unsampled_corner": UnsampledCorner({"x [m]": 1.0, "y [m]": -1.0}, 1.1 * CORNER, np.zeros(2))},
        "the corner x 1 m, y -1 m",
    ),
    ({"highest": 1.1 * BEST / TESTED}, "predicted to be 1.1, but the largest executed one is 0.8"),
    ({"predictions": (prediction(1, 0.9 * MATTERS, 0.9 * MATTERS),) * 3}, "small distances hardly test it"),
    (
        {"tests": 8, "predictions": (*GOOD.predictions, *TESTS[:7])},
        "at least 1 more execution must be predicted beforehand",
    ),
    ({"peak_ratio": 1.4 * SHARP}, "one of the largest predicted distances falls by 7 %"),
    ({"jump": 2 * JUMP}, "the predicted distance jumps by up to 2 % of the bound"),
    ({"low_dimensional": True, "search_shortfall": 1 + 1.4 * AGREE}, "largest distances that differ by 7 %"),
    ({"low_dimensional": True, "disagreement": 1.4 * AGREE}, "largest distances that differ by 7 %"),
]
"""What withdraws the bound, and what is said then, in the order in which it is said."""


def test_good_evidence_withdraws_nothing() -> None:
    assert doubt() is None
    assert uncovered(GOOD) == []
    assert untested(GOOD, BEST, BOUND) == []


@pytest.mark.parametrize(("changed", "said"), BAD)
def test_each_diagnostic_withdraws_the_bound_and_says_what_helps(changed: dict[str, Any], said: str) -> None:
    found = doubt(**changed)
    assert found is not None
    assert said in found
    assert re.search("execut|record more|smaller|smoother", found)


def test_the_first_sentence_wins() -> None:
    for (first, said), (second, _) in combinations(BAD[:-2], 2):  # searches are deeper instead of jumps
        assert said in (doubt(**{**second, **first}) or "")


def test_predictions_that_could_not_fail_do_not_count() -> None:
    same = replace(prediction(4), new=False)
    imported = replace(prediction(4), origin="manual", stored=False)
    for one in (same, imported):
        said = doubt(predictions=(*GOOD.predictions[:2], one)) or ""
        assert "2 executions of different tasks were predicted" in said
        wrong = replace(GOOD, predictions=(*GOOD.predictions, replace(one, distance=0.9)))
        assert failed(wrong, BOUND) == wrong.predictions[-1]


def after(*predictions: CheckedPrediction) -> DynamicsEvidence:
    return replace(GOOD, predictions=predictions)


@pytest.mark.parametrize("distance", [0.5 - 1.1 * ACCURATE, 0.5 + 1.1 * ACCURATE])
def test_a_prediction_that_failed_raises_the_bound_until_its_error_is_small_beside_the_rise(distance: float) -> None:
    evidence = after(prediction(1), prediction(2, 0.5, distance), prediction(3))
    assert doubt_of(evidence, BEST, BOUND) is None
    assert raised(evidence, BOUND) == pytest.approx(BOUND + 1.1)
    assert raised(GOOD, BOUND) == BOUND


def test_the_largest_error_raises_the_bound() -> None:
    assert raised(after(prediction(1, 0.5, 0.6), prediction(2, 0.5, 0.3), prediction(3)), BOUND) == pytest.approx(5.0)
    assert raised(after(*GOOD.predictions, prediction(4, np.inf)), BOUND) == np.inf


def test_large_distances_count_as_tested_if_the_raised_bound_leaves_room_for_their_errors() -> None:
    beside = [prediction(k, 0.1, 0.1) for k in range(2)]
    assert doubt_of(after(*beside, prediction(2, 0.5, 0.6)), BEST, BOUND) is None
    assert "small distances hardly" in (doubt_of(after(*beside, prediction(2, 0.1, 0.2)), BEST, BOUND) or "")


@pytest.mark.parametrize(
    ("evidence", "fewest"),
    [
        (GOOD, 1),
        (replace(GOOD, executions=1), FEWEST - 1),
        (after(prediction(1), prediction(2)), 1),
        (after(), 3),
        (after(*GOOD.predictions, prediction(4, 0.5, 0.7)), 3),
        (after(prediction(0, 0.5, 0.7), *GOOD.predictions), 1),
        (replace(GOOD, coverage=replace(COVERED, beyond=gap(2 * BEYOND), marginal=gap(1.1 * GAP))), 2),
    ],
)
def test_the_fewest_executions_that_can_decide(evidence: DynamicsEvidence, fewest: int) -> None:
    assert fewest_missing(evidence, BEST, BOUND) == fewest


def test_a_failed_test_raises_the_bound_until_later_tests_are_complete_without_it() -> None:
    tested = replace(GOOD, tests=8, predictions=TESTS)
    assert doubt(tested) is None
    assert raised(tested, BOUND) == BOUND
    failing = (*TESTS[:3], replace(TESTS[3], distance=0.6), *TESTS[4:])
    assert raised(replace(tested, predictions=failing), BOUND) == pytest.approx(BOUND + 0.1 / ACCURATE)
    assert raised(replace(tested, predictions=(*failing, *TESTS[:3])), BOUND) > BOUND
    assert raised(replace(tested, predictions=(*failing, *TESTS[:4])), BOUND) == BOUND


def test_only_tests_matter_for_so_long() -> None:
    chosen = replace(TESTS[0], origin="covering", distance=0.6)
    assert raised(replace(GOOD, tests=7, predictions=(chosen, *TESTS[1:])), BOUND) == BOUND


def test_a_chosen_task_counts_as_no_test() -> None:
    chosen = (replace(TESTS[0], origin="covering"), *TESTS[1:])
    assert missing_tests(chosen, 8) == 1
    assert missing_tests(chosen, 7) == 0


def test_a_noisy_prediction_that_could_not_have_failed_counts_as_no_test() -> None:
    largest = max(test.distance for test in TESTS)
    noisy = replace(TESTS[0], quantiles=(0.0, 1.0), runs=100)
    for upper, missing in ((1.9 * largest, 0), (2.1 * largest, 1), (1e3 * largest, 1), (np.inf, 1)):
        assert missing_tests((replace(noisy, upper=upper), *TESTS[1:]), len(TESTS)) == missing
    assert missing_tests((replace(TESTS[0], upper=1e3), *TESTS[1:]), len(TESTS)) == 0  # its median must have agreed


def test_a_failure_long_ago_is_forgiven() -> None:
    long_ago = after(prediction(0, 0.1, 0.5), *GOOD.predictions)
    assert doubt_of(long_ago, BEST, BOUND) is None
    assert raised(long_ago, BOUND) == BOUND


def test_many_coordinates_may_leave_their_ranges_as_far_as_they_may_leave_gaps() -> None:
    wide = replace(COVERED, pair=None, beyond=gap(0.9 * GAP))
    assert doubt(coverage=wide) is None
    assert "leave the recorded range" in (doubt(coverage=replace(wide, beyond=gap(1.1 * GAP))) or "")


@pytest.mark.parametrize("jumps", [{"peak_ratio": 1.4 * SHARP}, {"jump": 2 * JUMP}])
def test_jumps_withdraw_nothing_if_they_are_small_or_searched_more_deeply(jumps: dict[str, float]) -> None:
    assert "use a smoother model, or an audit" in (doubt(**jumps) or "")
    assert doubt(low_dimensional=True, **jumps) is None
    assert doubt(**{name: 0.1 * value for name, value in jumps.items()}) is None


def test_a_test_that_failed_is_outlived_by_tests_and_not_by_other_executions() -> None:
    """A vague prediction at the start must not cost more than the tests that replace it."""

    def made(trial: int, distance: float, origin: Origin = "spread") -> CheckedPrediction:
        point = (trial / 20, 0.5)
        return CheckedPrediction(trial, 0.5, 0.95, 1.0, distance, stored=True, new=True, origin=origin, point=point)

    early = made(0, 0.5)
    later = [made(k, 0.95) for k in range(1, 9)]
    best, bound = 0.95, 1.0

    def with_(predictions: list[CheckedPrediction]) -> DynamicsEvidence:
        return replace(GOOD, tests=8, predictions=tuple(predictions))

    raised_by_it = with_([early, *later[:7]])
    assert only_a_failed_test(raised_by_it, best, bound, 2.0)
    assert not only_tests_missing(raised_by_it, best, bound)
    assert not only_a_failed_test(raised_by_it, best, bound, 20.0)  # the raised bound keeps this limit already
    assert not only_a_failed_test(with_([early, *later]), best, bound, 2.0)  # eight later tests outlive it
    assert not only_a_failed_test(with_([*later[:7], made(9, 0.5)]), best, bound, 2.0)  # the last one failed
    chosen = made(9, 0.5, "covering")
    assert not only_a_failed_test(with_([*later, chosen]), best, bound, 2.0)
    uncovered_ = replace(raised_by_it, coverage=replace(COVERED, beyond=gap(0.5)))
    assert not only_a_failed_test(uncovered_, best, bound, 2.0)


def test_a_parameter_that_m_ignores_needs_twice_as_many_tests() -> None:
    ignored = replace(GOOD, unsampled_parameter=UnsampledParameter("load", 0.1, np.zeros(2), idle=True))
    obstacle = replace(GOOD, unsampled_parameter=UnsampledParameter("obstacle", 0.1, np.zeros(2)))
    assert [evidence.needing(8).tests for evidence in (GOOD, obstacle, ignored)] == [8, 8, 16]
    assert ignored.needing(22).tests == 22  # independent draws
    assert ignored.needing(0).tests == 0
    tested = replace(ignored, predictions=(*GOOD.predictions, *TESTS))
    assert doubt(tested.needing(4)) is None
    assert "8 more executions must be predicted" in (doubt(tested.needing(8)) or "")
