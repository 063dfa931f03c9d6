"""Tests of whether the law that all executions teach explains every one of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates.explained import (
    ExplainedExecution,
    evidence_against,
    least_explained,
    share_supported,
    support_of,
)
from ctxval.certificates.limits import LIMITS
from ctxval.core.quantiles import LEVELS

RUNS = 200
LAW = tuple(LEVELS.tolist())  # distances are uniform between 0 and 1 under the law


def executions(distances: list[float], p_values: np.ndarray | None = None) -> list[ExplainedExecution]:
    of_trajectories = np.full((len(distances), 3), 0.5) if p_values is None else p_values
    each = zip(distances, of_trajectories.tolist(), strict=True)
    return [ExplainedExecution(k, (0.5,), d, 0.5, LAW, RUNS, tuple(p)) for k, (d, p) in enumerate(each)]


@pytest.mark.parametrize("count", [8, 14, 25])
def test_a_true_law_is_contradicted_seldom(count: int) -> None:
    rng = np.random.default_rng(count)
    drawn = [executions(rng.random(count).tolist(), rng.random((count, 3))) for _ in range(400)]
    assert np.mean([evidence_against(each) > LIMITS.contradicted for each in drawn]) < 0.03


def test_two_distances_that_noise_does_not_explain_contradict_it_among_many_that_it_does() -> None:
    usual = np.linspace(0.1, 0.9, 12).tolist()
    assert evidence_against(executions([*usual, 1.5])) < LIMITS.contradicted
    for order in ([1.5, 1.5, *usual], [1.5, *usual, 1.5], [*usual, 1.5, 1.5]):  # evidence does not expire
        assert evidence_against(executions(order)) > LIMITS.contradicted
    least = least_explained(executions([*usual, 1.5]))
    assert least is not None
    assert (least.trial, least.p_value) == (12, pytest.approx(1 / (1 + RUNS)))


def test_a_law_without_noise_has_no_evidence() -> None:
    silent = [ExplainedExecution(0, (0.5,), 0.3, 0.3)]
    assert evidence_against(silent) == 1.0
    assert least_explained(silent) is None
    assert support_of(silent, 0.1, 1.0, 0.9) == 1.0


def test_excesses_that_the_law_does_not_expect_speak_against_a_threshold() -> None:
    below = [0.5] * 11
    assert support_of(executions(below), 1.1, 1.0, 0.9) > 2
    assert support_of(executions([*below, 1.2, 1.2]), 1.1, 1.0, 0.9) < 0.1
    # An excess that the law expects as often as is permitted is no evidence.
    assert support_of(executions([0.95]), 0.9, 1.0, 0.9) == pytest.approx(1.0, abs=0.05)


def test_executions_far_below_the_bound_tell_nothing_of_the_threshold() -> None:
    assert support_of(executions([0.5] * 11), 1.1, 2.0, 0.9) == 1.0


@pytest.mark.parametrize(("count", "above", "percent"), [(29, 0, 90.2), (14, 0, 80.7), (14, 1, 70.3), (3, 3, 0.0)])
def test_the_share_that_executions_support_without_a_law(count: int, above: int, percent: float) -> None:
    assert 100 * share_supported(count, above, 0.95) == pytest.approx(percent, abs=0.1)


@given(st.integers(1, 40), st.integers(0, 40), st.floats(0.5, 0.99))
def test_more_executions_support_more(count: int, above: int, confidence: float) -> None:
    share = share_supported(count, min(above, count), confidence)
    assert 0 <= share < 1
    assert share_supported(count + 1, min(above, count), confidence) >= share
    assert share_supported(count + 1, min(above, count) + 1, confidence) <= share
