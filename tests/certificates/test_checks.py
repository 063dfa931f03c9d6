"""The gate as a table: what withdraws the bound, and what closes a check, from evidence in plain numbers."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from ctxval.certificates import CheckedPrediction, Evidence, UnsampledCorner, UnsampledParameter
from ctxval.certificates import checks as table
from ctxval.certificates.checks import CHECKS, Check, Gap, Remedy, fewest_missing, open_checks, withdrawals
from ctxval.certificates.explained import ExplainedExecution
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.predictions import missing_tests
from ctxval.core.coverage import UnvisitedRegion
from ctxval.core.trial import Origin
from facts import assert_names
from rig_evidence import COVERED, GOOD, gap, prediction

BEST, BOUND = 0.8, 1.0
GOOD = replace(GOOD, maxima=np.full(40, BOUND))


def first(evidence: Evidence = GOOD, **changed: Any) -> str | None:
    """Return the code of the check that withdraws the bound; None if none does."""
    return next((opened.code for opened in withdrawals(replace(evidence, **changed))), None)


TESTS = tuple(replace(prediction(k + 3), origin="spread", point=(k / 9, 1 - k / 9)) for k in range(1, 9))
REGION = UnvisitedRegion(1.1 * LIMITS.region, {"x [m]": 1.0}, {"x [m]": 0.1}, ((0.1, 0.2),))
BAD: list[tuple[dict[str, Any], str]] = [
    ({"executions": LIMITS.fewest - 1}, "few_executions"),
    ({"unplanned": 0.01}, "not_planned"),
    ({"predictions": GOOD.predictions[:2]}, "few_predictions"),
    ({"noise": 2 * LIMITS.noise}, "noisy"),
    ({"left_out": 1.1 * LIMITS.left_out}, "left_out"),
    ({"influential": (0.1, 0.2)}, "executed_once"),
    ({"unsampled_parameter": UnsampledParameter("load", 1.1 * LIMITS.gap, np.zeros(2))}, "unsampled_parameter"),
    (
        {"unsampled_corner": UnsampledCorner({"x [m]": 1.0, "y [m]": -1.0}, 1.1 * LIMITS.corner, np.zeros(2))},
        "unsampled_corner",
    ),
    ({"unvisited_region": REGION}, "unvisited_region"),
    ({"coverage": replace(COVERED, beyond=gap(2 * LIMITS.diverged))}, "diverged"),
    ({"coverage": replace(COVERED, beyond=gap(2 * LIMITS.beyond))}, "beyond"),
    ({"coverage": replace(COVERED, marginal=gap(1.1 * LIMITS.gap))}, "gap"),
    ({"coverage": replace(COVERED, pair=gap(1.1 * LIMITS.pair_gap, "x[0]", "u[0]"))}, "pair_gap"),
    ({"highest": 1.1 * BEST / LIMITS.tested}, "not_tested"),
    ({"predictions": (prediction(1, 0.9 * LIMITS.matters, 0.9 * LIMITS.matters),) * 3}, "none_held"),
    ({"tests": 8, "predictions": (*GOOD.predictions, *TESTS[:7])}, "tests_missing"),
    ({"executed": (ExplainedExecution(1, (0.5, 0.5), 0.5, 0.5 + 1.1 * LIMITS.error * BOUND),)}, "unexplained"),
    ({"drift": ("their order", 0.5 * LIMITS.drifting)}, "drift"),
    ({"uneven": 1.1 * LIMITS.uneven}, "uneven_friction"),
    ({"peak_ratio": 1.4 * LIMITS.peak_ratio}, "needle"),
    ({"jump": 2 * LIMITS.jump}, "jump"),
    ({"low_dimensional": True, "search_shortfall": 1 + 1.4 * LIMITS.agree}, "searches_differ"),
    ({"low_dimensional": True, "disagreement": 1.4 * LIMITS.agree}, "searches_differ"),
]
"""Evidence that opens one check each, in the order of the table."""


def test_good_evidence_opens_no_check() -> None:
    assert open_checks(GOOD) == []
    assert open_checks(replace(GOOD, threshold=BOUND)) == []


@pytest.mark.parametrize(("changed", "code"), BAD)
def test_each_check_withdraws_the_bound_with_all_values_of_its_sentence(changed: dict[str, Any], code: str) -> None:
    opened = withdrawals(replace(GOOD, **changed))
    assert [each.code for each in opened] == [code]
    assert opened[0].gap.size > (opened[0].gap.limit or 0.0)
    assert "{" not in str(opened[0])  # all places of the sentence are filled


def test_the_first_check_of_the_table_wins() -> None:
    for (changed, code), (other, _) in combinations(BAD[:-2], 2):  # searches are intensified in the place of jumps
        merged = {**other, **changed}
        if len(merged) == len(other) + len(changed):
            assert first(**merged) == code


def test_codes_are_unique_and_all_are_described() -> None:
    assert len({check.code for check in CHECKS}) == len(CHECKS)
    for check in CHECKS:
        assert check.reason.endswith(".")
        assert bool(check.sentence) == (check.stage != "bound")


def test_a_new_check_withdraws_the_bound_and_chooses_the_next_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """A check is one entry of the table: gate, next task, forecast and JSON follow."""
    task = np.array([[0.25, 0.75]])

    def loops(evidence: Evidence) -> Gap:
        return Gap(evidence.evaluations, {"loops": evidence.evaluations})

    def there(evidence: Evidence, known: int) -> Remedy:
        return Remedy((task,))

    new = Check("few_loops", "coverage", 8999, loops, "{loops} closed loops are too many", "For this test.", there)
    monkeypatch.setattr(table, "CHECKS", (*CHECKS, new))
    (opened,) = withdrawals(GOOD)
    assert opened.code == "few_loops"
    assert_names(str(opened), 9000, "loops")
    assert opened.to_json() == {"code": "few_loops", "stage": "coverage", "size": 9000, "limit": 8999}
    assert new.remedy is not None
    np.testing.assert_array_equal(new.remedy(GOOD, 3).tasks[0], task)
    assert fewest_missing(GOOD) == 1


def test_predictions_that_could_not_fail_do_not_count() -> None:
    same = replace(prediction(4), new=False)
    imported = replace(prediction(4), origin="manual", stored=False)
    for one in (same, imported):
        assert first(predictions=(*GOOD.predictions[:2], one)) == "few_predictions"
        wrong = replace(GOOD, predictions=(*GOOD.predictions, replace(one, distance=0.9)))
        assert wrong.failed == wrong.predictions[-1]


def after(*predictions: CheckedPrediction) -> Evidence:
    return replace(GOOD, predictions=predictions, maxima=np.full(40, BOUND))


def raised(evidence: Evidence) -> float:
    """Return by how much failed predictions raise the bound."""
    return evidence.raised - evidence.bound


@pytest.mark.parametrize("distance", [0.5 - 1.1 * LIMITS.error, 0.5 + 1.1 * LIMITS.error])
def test_a_prediction_that_failed_raises_the_bound_until_its_error_is_small_beside_the_rise(distance: float) -> None:
    evidence = after(prediction(1), prediction(2, 0.5, distance), prediction(3))
    assert first(evidence) is None
    assert raised(evidence) == pytest.approx(1.1)
    assert raised(GOOD) == 0.0


def test_the_largest_error_raises_the_bound() -> None:
    assert raised(after(prediction(1, 0.5, 0.6), prediction(2, 0.5, 0.3), prediction(3))) == pytest.approx(4.0)
    assert after(*GOOD.predictions, prediction(4, np.inf)).raised == np.inf


def test_large_distances_count_as_tested_if_the_raised_bound_leaves_room_for_their_errors() -> None:
    beside = [prediction(k, 0.1, 0.1) for k in range(2)]
    assert first(after(*beside, prediction(2, 0.5, 0.6))) is None
    assert first(after(*beside, prediction(2, 0.1, 0.2))) == "none_held"


@pytest.mark.parametrize(
    ("evidence", "fewest"),
    [
        (GOOD, 1),
        (replace(GOOD, executions=1), LIMITS.fewest - 1),
        (after(prediction(1), prediction(2)), 1),
        (after(), 3),
        (after(*GOOD.predictions, prediction(4, 0.5, 0.7)), 3),
        (after(prediction(0, 0.5, 0.7), *GOOD.predictions), 1),
        (
            replace(GOOD, coverage=replace(COVERED, beyond=gap(2 * LIMITS.beyond), marginal=gap(1.1 * LIMITS.gap))),
            2,
        ),
    ],
)
def test_the_fewest_executions_that_can_decide(evidence: Evidence, fewest: int) -> None:
    assert fewest_missing(evidence) == fewest


def test_a_failed_test_raises_the_bound_until_later_tests_are_complete_without_it() -> None:
    tested = replace(GOOD, tests=8, predictions=TESTS)
    assert first(tested) is None
    assert raised(tested) == 0.0
    failing = (*TESTS[:3], replace(TESTS[3], distance=0.6), *TESTS[4:])
    assert raised(replace(tested, predictions=failing)) == pytest.approx(0.1 / LIMITS.error)
    assert raised(replace(tested, predictions=(*failing, *TESTS[:3]))) > 0
    assert raised(replace(tested, predictions=(*failing, *TESTS[:4]))) == 0.0


def test_only_tests_matter_for_so_long() -> None:
    chosen = replace(TESTS[0], origin="covering", distance=0.6)
    assert raised(replace(GOOD, tests=7, predictions=(chosen, *TESTS[1:]))) == 0.0


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
    assert first(long_ago) is None
    assert raised(long_ago) == 0.0


def test_many_coordinates_may_leave_their_ranges_as_far_as_they_may_leave_gaps() -> None:
    wide = replace(COVERED, pair=None, beyond=gap(0.9 * LIMITS.gap))
    assert first(coverage=wide) is None
    assert first(coverage=replace(wide, beyond=gap(1.1 * LIMITS.gap))) == "beyond"


@pytest.mark.parametrize("jumps", [{"peak_ratio": 1.4 * LIMITS.peak_ratio}, {"jump": 2 * LIMITS.jump}])
def test_jumps_withdraw_nothing_if_they_are_small_or_searched_more_deeply(jumps: dict[str, float]) -> None:
    assert first(**jumps) in ("needle", "jump")
    assert first(low_dimensional=True, **jumps) is None
    assert first(**{name: 0.1 * value for name, value in jumps.items()}) is None


def test_a_parameter_that_m_ignores_needs_twice_as_many_tests() -> None:
    ignored = replace(GOOD, unsampled_parameter=UnsampledParameter("load", 0.1, np.zeros(2), idle=True))
    obstacle = replace(GOOD, unsampled_parameter=UnsampledParameter("obstacle", 0.1, np.zeros(2)))
    assert [evidence.needing(8).tests for evidence in (GOOD, obstacle, ignored)] == [8, 8, 16]
    assert ignored.needing(22).tests == 22  # independent draws
    assert ignored.needing(0).tests == 0
    tested = replace(ignored, predictions=(*GOOD.predictions, *TESTS))
    assert first(tested.needing(4)) is None
    (opened,) = withdrawals(tested.needing(8))
    assert (opened.code, opened.gap.size) == ("tests_missing", 8)


# What closes a check


def remedy(evidence: Evidence, known: int = 3) -> tuple[str, Remedy]:
    """Return the code of the first open check that an execution closes, and what closes it."""
    return next((each.code, each.check.remedy(evidence, known)) for each in open_checks(evidence) if each.check.remedy)


def test_a_test_that_failed_is_outlived_by_tests_and_not_by_other_executions() -> None:
    """A vague prediction at the start must not cost more than the tests that replace it."""

    def made(trial: int, distance: float, origin: Origin = "spread", explained: float | None = 0.95) -> Any:
        point = (trial / 20, 0.5)
        known = CheckedPrediction(trial, 0.5, 0.95, 1.0, distance, stored=True, new=True, origin=origin, point=point)
        return replace(known, explained=explained)

    early = made(0, 0.5, explained=0.5)
    later = [made(k, 0.95) for k in range(1, 9)]

    def asked(predictions: list[CheckedPrediction], threshold: float = 2.0, **changed: Any) -> Evidence:
        values = {"tests": 8, "predictions": tuple(predictions), "threshold": threshold, "best": 0.95}
        return replace(GOOD, **{**values, **changed})

    code, drawn = remedy(asked([early, *later[:7]]))
    assert (code, drawn.kind) == ("failed_prediction", "drawn")
    assert open_checks(asked([early, *later[:7]], 20.0)) == []  # the raised bound keeps this threshold already
    assert open_checks(asked([early, *later])) == []  # eight later tests outlive it
    assert remedy(asked([*later[:7], made(9, 0.5, explained=0.5)]))[1].kind == "new"  # the last one failed
    assert remedy(asked([*later, made(9, 0.5, "covering")]))[1].kind == "new"
    uncovered = asked([early, *later[:7]], coverage=replace(COVERED, beyond=gap(0.5)))
    assert remedy(uncovered)[0] == "beyond"


def test_dynamics_that_depend_on_the_task_are_looked_for_next_to_the_failed_test() -> None:
    test = replace(TESTS[3], distance=0.9, explained=0.5)
    evidence = replace(GOOD, predictions=(*TESTS[:3], test), threshold=1.5, idle=(1,))
    code, asked = remedy(evidence)
    assert code == "failed_test"
    (x, y), (a, b) = evidence.worst, test.point
    np.testing.assert_allclose(asked.tasks[0], [[x, b], [a, y]])  # the parameter that M ignores comes first


def test_a_noisy_execution_that_matters_most_is_repeated() -> None:
    code, asked = remedy(replace(GOOD, influential=(0.1, 0.2), threshold=2.0))
    assert (code, asked.kind) == ("executed_once", "again")
    np.testing.assert_array_equal(asked.tasks[0], [[0.1, 0.2]])


def test_missing_tests_are_drawn_once_nothing_else_is_open() -> None:
    missing = replace(GOOD, tests=8, threshold=2.0)
    assert (remedy(missing)[0], remedy(missing)[1].kind) == ("tests_missing", "drawn")
    assert remedy(replace(missing, unvisited_region=REGION))[0] == "unvisited_region"
    np.testing.assert_array_equal(remedy(replace(missing, unvisited_region=REGION))[1].tasks[0], [[0.1, 0.2]])


def test_while_a_draw_exceeds_the_threshold_every_third_task_leads_farthest_from_the_records() -> None:
    exceeding = replace(GOOD, threshold=0.97, maxima=np.linspace(0.9, 1.0, 40))
    for known, farthest in ((2, True), (3, False), (5, True)):
        code, asked = remedy(exceeding, known)
        assert code == "exceeds"
        assert np.array_equal(asked.tasks[0], COVERED.task[None]) is farthest
    largest = remedy(replace(exceeding, threshold=0.94), 3)[1]
    np.testing.assert_array_equal(largest.tasks[0], GOOD.local_maxima)  # the mean exceeds it
