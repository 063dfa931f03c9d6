from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval.certificates.bets import bets_against
from ctxval.certificates.verdict import counterexample, judge
from ctxval.core.quantiles import LEVELS, chance_of_more
from ctxval.core.trial import Trial
from ctxval.core.trial_note import NO_NOTE, TrialNote
from facts import assert_names


def trial(number: int, distance: float, predicted: np.ndarray | None = None) -> Trial:
    note = NO_NOTE
    if predicted is not None:
        quantiles = np.quantile(predicted, LEVELS).tolist()
        note = TrialNote(prediction={"noise": {"distances": quantiles, "runs": len(predicted)}})
    point = np.array([0.05 * number])
    return Trial(number, "covering", "completed", point, {"p": point}, distance=distance, note=note)


def test_two_predicted_excesses_falsify_and_one_does_not() -> None:
    likely = np.linspace(0.9, 1.6, 200)
    one = [trial(0, 1.2, likely)]
    assert counterexample(one, 1.0) is None
    both = [*one, trial(1, 1.1, likely)]
    verdict = counterexample(both, 1.0)
    assert verdict is not None
    assert verdict.answer == "falsified"
    assert_names(verdict.reason, 2)


def test_a_repetition_is_a_bet_on_another_excess_whatever_was_predicted() -> None:
    unlikely = np.linspace(0.1, 0.9, 200)
    first = trial(0, 1.2, unlikely)
    repeated = [first, *(replace(first, number=number) for number in (1, 2))]
    wealth = [bets_against(repeated[:k], 1.0).wealth for k in (1, 2, 3)]  # type: ignore[union-attr]
    assert wealth == pytest.approx([1.0, 9.0, 81.0])


def test_two_repetitions_of_an_excess_falsify_whatever_was_predicted_wrongly_before() -> None:
    likely = np.linspace(0.9, 1.6, 200)
    wrong = [trial(number, 0.5, likely) for number in range(5)]
    excess = trial(5, 1.2, likely)
    assert counterexample([*wrong, excess, replace(excess, number=6)], 1.0) is None
    assert counterexample([*wrong, excess, replace(excess, number=6), replace(excess, number=7)], 1.0) is not None


def test_without_noise_one_execution_falsifies() -> None:
    assert counterexample([trial(0, 1.2)], 1.0) is not None
    assert bets_against([trial(0, 1.2)], 1.0) is None


def test_noise_that_is_no_longer_predicted_explains_no_excess_that_repeats_to_the_last_digit() -> None:
    unlikely = np.linspace(0.1, 0.9, 200)
    silent = TrialNote(prediction={"noise": None, "quantiles": [0.5]})
    early, excess = trial(0, 0.5, unlikely), replace(trial(1, 1.2), note=silent)
    again = replace(excess, number=2)
    assert counterexample([early, excess], 1.0) is None
    assert counterexample([early, excess, again], 1.0) is not None
    assert counterexample([early, excess, replace(again, distance=1.1)], 1.0) is None
    assert counterexample([early, excess, again, trial(3, 0.5, unlikely)], 1.0) is None


def test_an_undecided_verdict_says_that_noise_may_explain_an_excess() -> None:
    likely = np.linspace(0.5, 1.3, 200)
    reason = judge([trial(0, 0.9, likely), trial(1, 1.1, likely)], 1.0).reason
    assert_names(reason, 1, 2, 1.81)


@pytest.mark.parametrize("quantile", [0.8, 0.9])
@pytest.mark.thorough
def test_the_bets_rarely_win_if_the_threshold_holds(quantile: float) -> None:
    # Executions exceed the threshold with the largest chance that is permitted, whatever was predicted.
    rng, won = np.random.default_rng(0), 0
    predictions = [np.linspace(0.2, 1.05, 50), np.linspace(0.9, 1.5, 50), None]
    for _ in range(1000):
        trials = []
        for number in range(15):
            exceeds = rng.random() < 1 - quantile
            trials.append(trial(number, 1.1 if exceeds else 0.9, predictions[rng.integers(3)]))
            bets = bets_against(trials, 1.0, quantile)
            if bets is not None and bets.falsify(0.95):
                won += 1
                break
    assert won <= 0.05 * 1000 + 2 * np.sqrt(1000 * 0.05 * 0.95)
    assert won > 0


def test_a_chance_is_interpolated_and_never_zero() -> None:
    quantiles = np.quantile(np.linspace(0, 1, 101), LEVELS).tolist()
    assert chance_of_more(quantiles, 0.3, 10_000) == pytest.approx(0.7, abs=1e-3)
    assert chance_of_more(quantiles, 5.0, 200) == pytest.approx(1 / 201)
    assert chance_of_more([*quantiles[:-1], np.inf], 2.0, 200) > 1 / 201
