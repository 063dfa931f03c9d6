"""The state of a watch: evidence, alarm, sentence and JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ctxval.certificates.expiry import EXCEEDED, WatchedChannel, WatchState
from ctxval.core.learned_numbers import Statistic
from ctxval.errors import InputError
from facts import assert_names, refuses
from rig_thorough import more


def begun(channels: int = 2, false_alarms: float = 1e-3) -> WatchState:
    certified = np.random.default_rng(0).chisquare(4, (channels, 12)) / 4
    names = ["rate residuals", "errors of the predicted distance", "angle residuals"]
    listed = [
        WatchedChannel(name, tuple(row), 4.0, 12.0 * np.eye(2)) for name, row in zip(names, certified, strict=False)
    ]
    return WatchState(0.5, false_alarms, tuple(listed))


def watched(state: WatchState, scale: float, runs: int, seed: int = 1) -> WatchState:
    """Return the state after runs whose rate residuals are so many times as large as those certified."""
    rng = np.random.default_rng(seed)
    for _ in range(runs):
        rate, other = np.array([scale**2, 1.0]) * rng.chisquare(4, 2) / 4
        gradient = rng.standard_normal(2)
        statistics = {
            "rate residuals": Statistic(float(rate), gradient, np.eye(2)),
            "errors of the predicted distance": Statistic(float(other)),
        }
        state = state.after(str(len(state.runs) + 1), statistics)
    return state


@pytest.mark.slow
def test_it_says_what_has_changed_and_since_when() -> None:
    calm = watched(begun(), 1.0, 40)
    assert not calm.expired
    assert_names(calm.sentence, 40)
    state = watched(calm, 3.0, 6, seed=2)
    assert state.expired
    assert state.cause == "rate residuals"
    assert state.alarm is not None
    assert state.since is not None
    assert 39 <= state.since <= state.alarm <= 46
    assert_names(state.sentence, "expired", "since", state.since, f"{state.ratio:.2g}")
    assert 2 < (state.ratio or 0) < 4.5


def test_evidence_that_is_too_little_for_an_alarm_is_no_agreement() -> None:
    state = begun()
    while state.evidence < 20:
        state = watched(state, 3.0, 1, seed=len(state.runs))
    assert not state.expired
    assert_names(state.sentence, "since", state.since, f"{state.ratio:.2g}")
    assert_names(state.sentence, "runs")


def test_an_alarm_stays() -> None:
    state = watched(begun(), 4.0, 8)
    after = watched(state, 1.0, 30, seed=3)
    assert (after.alarm, after.sentence) == (state.alarm, state.sentence)


@pytest.mark.slow
def test_the_rate_of_false_alarms_decides_how_much_evidence_is_needed() -> None:
    alarms = [watched(begun(false_alarms=rate), 2.0, 30).alarm or 99 for rate in (0.1, 1e-3, 1e-6)]
    assert alarms == sorted(alarms)
    assert alarms[0] < alarms[-1]


@pytest.mark.slow
@pytest.mark.parametrize(("watches", "most"), [(2, 0), *more((8, 2))])
def test_unchanged_runs_hardly_ever_raise_an_alarm(watches: int, most: int) -> None:
    """Watches of 60 runs at a rate of one in 100 runs: an e-detector is far below what it may be."""
    alarms = [watched(begun(false_alarms=0.01), 1.0, 60, seed=10 + k).expired for k in range(watches)]
    assert sum(alarms) <= most


def test_a_run_without_a_statistic_says_nothing_of_it() -> None:
    state = begun()
    only = state.after("a", {"rate residuals": Statistic(1.0)})
    assert only.channels[1].later == (None,)
    assert only.channels[1].evidence()[0] == -np.inf
    both = only.after("b", {name: Statistic(1.0) for name in ("rate residuals", "errors of the predicted distance")})
    assert both.channels[1].evidence()[1] == 2


def test_it_is_data() -> None:
    state = watched(begun(), 2.5, 9)
    text = json.dumps(state.to_json(), allow_nan=False)
    again = WatchState.from_json(json.loads(text))
    assert json.dumps(again.to_json()) == text
    assert watched(again, 1.0, 2).evidence == watched(state, 1.0, 2).evidence
    assert json.loads(text)["expired"] is state.expired


@pytest.mark.parametrize("change", [{"channels": None}, {"runs": ["a", "b"]}, {"threshold": "large"}])
def test_other_data_is_refused(change: dict[str, object]) -> None:
    with refuses(InputError, "watch", "to_json"):
        WatchState.from_json({**watched(begun(), 1.0, 1).to_json(), **change})


def test_an_executed_distance_above_the_threshold_is_a_fact_unless_there_is_noise() -> None:
    statistics = {"rate residuals": Statistic(1.0)}
    exact = WatchState(0.5, 1e-3, (WatchedChannel("rate residuals", (1.0, 1.1, 0.9)),))
    state = exact.after("a", statistics, 0.5).after("b", statistics, 0.75)
    assert (state.alarm, state.cause, state.ratio) == (2, EXCEEDED, 1.5)
    assert_names(state.sentence, "expired", 2, 0.75, 0.5)
    assert WatchState.from_json(state.to_json()).sentence == state.sentence
    noisy = begun().after("a", statistics, 0.75)
    assert noisy.has_noise
    assert not noisy.expired
