"""The bound on the tasks of a suite that were not executed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from ctxval.certificates import Automatic, CertificateOptions, Learned, Provenance, Sample, WholeSuite, judge
from ctxval.certificates.evidence import SuiteRuns
from ctxval.certificates.remaining import DistanceLaw, RemainingTasks
from ctxval.core.task_suite import TaskSuite
from ctxval.core.trial import Origin, Trial

SIZES = np.geomspace(0.5, 2.0, 40)
SUITE = TaskSuite({f"run {k}": {"size": float(size)} for k, size in enumerate(SIZES)})


def distances(seed: int = 0, deviation: float = 0.1) -> np.ndarray:
    return np.asarray(0.2 * SIZES**1.5 * np.exp(deviation * np.random.default_rng(seed).normal(size=len(SIZES))))


def runs(beyond: float = 0.0) -> SuiteRuns:
    assert SUITE.features is not None
    return SuiteRuns(SUITE.features, np.full(len(SIZES), beyond))


def executed(count: int = 24, drawn: int = 8, seed: int = 0) -> list[Trial]:
    """Return trials of tasks in a random order, the largest first and the drawn ones last."""
    known = distances(seed)
    order = np.random.default_rng(seed).permutation(len(SIZES) - 1)[: count - 1]
    made = []
    for number, row in enumerate([len(SIZES) - 1, *order.tolist()]):
        origin: Origin = "spread" if number >= count - drawn else "acquisition"
        task, at = {"task": SUITE.task_names[row]}, SUITE.members[row]
        made.append(Trial(number, origin, "completed", at, task, 1, True, float(known[row])))
    return made


def left(trials: list[Trial], beyond: float = 0.0, tests: int = 8) -> RemainingTasks:
    sample = replace(Sample.of(trials), suite=SUITE.members, learned=Learned(suite=runs(beyond)))
    return RemainingTasks(sample, tests)


def test_features_are_logarithms_of_positive_parameters() -> None:
    mixed = TaskSuite({"a": {"size": 1.0, "offset": -1.0}, "b": {"size": np.e, "offset": 2.0}})
    assert np.allclose(mixed.features, [[0, -1], [1, 2]])
    assert TaskSuite(["a", "b"]).features is None


def test_the_law_without_features_is_that_of_a_further_draw_of_a_normal_sample() -> None:
    y = np.random.default_rng(1).normal(-2.0, 0.5, 12)
    law = DistanceLaw.given(np.empty((12, 0)), np.exp(y), np.empty((1, 0)))
    scale = y.std(ddof=1) * np.sqrt(1 + 1 / 12)
    assert law.bound(0.95) == pytest.approx(np.exp(y.mean() + stats.t.ppf(0.95, 11) * scale))
    assert law.above(np.exp(y.mean()))[0] == pytest.approx(0.5)


def test_the_bound_holds_as_often_as_stated() -> None:
    rng, held = np.random.default_rng(2), []
    for _ in range(400):
        X = rng.uniform(-1, 1, (40, 2))
        d = np.exp(X @ [1.0, 0.3] + 0.6 * rng.normal(size=40))
        law = DistanceLaw.given(X[:25], d[:25], X[25:])
        held.append(d[25:].max() <= law.bound(0.95))
    assert 0.93 <= np.mean(held) <= 0.98


@pytest.mark.parametrize(
    ("trials", "beyond", "code"),
    [
        (executed(), 0.0, None),
        (executed(drawn=7), 0.0, "tests_missing"),
        (executed(), 0.3, "beyond"),
        ([*executed()[:-1], replace(executed()[-1], distance=0.9)], 0.0, "contradicted"),
    ],
)
def test_what_withdraws_the_bound(trials: list[Trial], beyond: float, code: str | None) -> None:
    withdrawal = left(trials, beyond).withdrawal()
    assert (withdrawal and withdrawal[0]) == code
    learned = Learned(suite=runs(beyond))
    verdict = judge(trials, 1.0, CertificateOptions(Automatic()), Provenance(space=SUITE, learned=learned))
    assert verdict.answer == ("validated" if code is None else "undecided")
    assert verdict.certificate is not None
    assert verdict.certificate.kind == "suite"
    assert verdict.certificate.withdrawn_by == code
    assert verdict.certificate.details["not_executed"] == 16


def test_tests_alone_show_how_many_tasks_may_exceed_the_largest_of_them() -> None:
    remaining, misses = left(executed()), []
    count = remaining.missed_by_tests(0.95)
    tasks, before, rng = 40, 24 - 8, np.random.default_rng(3)
    for k in (count, count + 1):  # tasks that exceed, among those that are not executed before the tests
        drawn = np.argsort(rng.random((20_000, tasks - before)), axis=1)[:, :8]
        misses.append(float((drawn >= k).all(axis=1).mean()))
    assert misses[0] > 0.05 > misses[1]
    assert left(executed(12, drawn=0)).missed_by_tests(0.95) == 28


def test_a_law_needs_executions_numbers_and_positive_distances() -> None:
    assert left(executed(10, drawn=0)).can_be_bounded
    assert not left(executed(9, drawn=0)).can_be_bounded
    assert left(executed(33, drawn=2)).can_be_bounded
    assert not left(executed(33, drawn=1)).can_be_bounded  # the seven that are left would all be tests
    assert not left([*executed(12)[:-1], replace(executed(12)[-1], distance=0.0)]).can_be_bounded
    assert not RemainingTasks(replace(left(executed()).sample, learned=Learned()), 8).can_be_bounded
    exact = judge(executed(), 1.0, CertificateOptions(WholeSuite()), Provenance(space=SUITE))
    assert exact.answer == "undecided"
    assert exact.certificate is None


def test_the_next_task_leads_beyond_the_records_then_is_drawn_then_may_exceed_the_threshold() -> None:
    few = executed(20, drawn=0)
    remaining = left(few, 0.3)
    assert remaining.next_row(0.5) in remaining.rows
    assert left(few).next_row(0.5) is None
    known = left(executed())
    assert known.next_row(0.5) == known.rows.max()  # distances grow with the size
