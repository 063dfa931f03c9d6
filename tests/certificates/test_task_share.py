from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval.certificates import CertificateOptions
from ctxval.certificates.automatic import Automatic
from ctxval.certificates.dynamics import Dynamics, certify_dynamics
from ctxval.certificates.sample import Sample
from ctxval.certificates.task_share import bet_on, bets_on_share
from ctxval.certificates.verdict import counterexample, judge_by
from ctxval.core.target import Share
from ctxval.core.trial import Origin, Trial
from ctxval.core.trial_note import TrialNote
from ctxval.errors import InputError
from rig_evidence import GOOD

TAU, SHARE = 1.0, 0.99


def trial(number: int, distance: float, part: float | None = None, stake: float = 0.8, origin: Origin = "iid") -> Trial:
    point = np.array([0.01 * number])
    note = TrialNote(predicted_above=None if part is None else (TAU, part, stake))
    origin = origin if part is None else "covering"
    return Trial(number, origin, "completed", point, {"p": point}, distance=distance, note=note)


def test_tasks_drawn_where_distances_above_are_predicted_falsify_a_share_and_chosen_ones_do_not() -> None:
    chosen = [trial(number, 1.5, origin="covering") for number in range(20)]
    assert counterexample(chosen, TAU, target=Share(SHARE)) is None
    assert counterexample(chosen, TAU) is not None
    drawn = [trial(number, 1.5, 0.02) for number in range(5)]
    bets = bets_on_share(drawn, TAU, SHARE, 0.95)
    assert bets.wealth == pytest.approx((0.2 + 0.8 * 2) ** 5)
    assert counterexample(drawn, TAU, target=Share(SHARE)) is None
    verdict = counterexample([*drawn, trial(5, 1.1, 0.02)], TAU, target=Share(SHARE))
    assert verdict is not None
    assert verdict.answer == "falsified"


def test_a_bet_counts_for_the_threshold_that_it_was_made_against_and_lost_ones_count() -> None:
    drawn = [trial(number, 1.5, 0.02) for number in range(6)]
    assert bets_on_share(drawn, 0.9, SHARE, 0.95).executions == 0
    lost = [*drawn, replace(trial(6, 0.5, 0.02), state="failed", distance=None)]
    assert bets_on_share(lost, TAU, SHARE, 0.95).wealth == pytest.approx(0.2 * 1.8**6)
    assert bets_on_share([*drawn, replace(drawn[0], number=6, state="open")], TAU, SHARE, 0.95).executions == 6


def test_three_of_ten_independent_draws_falsify_one_per_cent() -> None:
    draws = [trial(number, 1.5 if number < 3 else 0.5) for number in range(10)]
    bets = bets_on_share(draws, TAU, SHARE, 0.95)
    assert bets.wealth == pytest.approx(2.98**3 * 0.98**7)
    assert bets.falsify(0.95)
    assert 0.01 < bets.least < 0.02


def test_a_true_share_is_rarely_falsified_whatever_predicts_the_tasks_above() -> None:
    # Exactly 2 % of the tasks exceed tau, where x > 0.98; the prediction finds them among others, with an error.
    rng, share, falsified = np.random.default_rng(0), 0.98, 0
    for _ in range(400):
        trials: list[Trial] = []
        while len(trials) < 25 and not bets_on_share(trials, TAU, share, 0.9).falsify(0.9):
            tasks = rng.random(500)
            rows = np.flatnonzero(tasks > rng.choice([0.95, 0.97, 0.985]))
            if not len(rows):
                continue
            distance = 1.5 if tasks[rows[0]] > 0.98 else 0.5
            trials.append(trial(len(trials), distance, len(rows) / 500, rng.choice([0.3, 0.6])))
        falsified += bets_on_share(trials, TAU, share, 0.9).falsify(0.9)
    assert 0 < falsified <= 0.1 * 400


def test_the_stake_grows_with_the_share_that_is_predicted_above() -> None:
    assert bet_on(0.02, SHARE) == pytest.approx((0.9 - 0.5) / 0.5)
    assert bet_on(0.005, SHARE) == 0.0
    assert bet_on(0.0, SHARE) == 0.0
    assert bet_on(1.0, SHARE) <= 0.9


def test_a_bound_on_a_share_validates_although_an_execution_exceeds_it() -> None:
    points = np.random.default_rng(0).random((9, 2))
    distances = np.array([1.3, *np.full(8, 0.5)])
    evidence = replace(GOOD, target=Share(SHARE), best=1.3)
    sample = Sample(points, distances, ["covering", *["iid"] * 8], ["completed"] * 9, threshold=1.2)
    certificate = certify_dynamics(sample, replace(evidence, threshold=1.2))
    assert certificate.volume == pytest.approx(0.01)
    assert certificate.upper_bound < 1.1
    assert certificate.bound is None  # it is none on d*
    assert certificate.details["share"] == SHARE
    assert 0.3 < certificate.details["tests"]["share_missed"] < 0.34
    assert replace(certificate, volume=0.0).covers(1.2)
    assert not certificate.covers(1.2)
    options = CertificateOptions(Automatic(share=SHARE))
    assert options.left_out == certificate.volume
    trials = [trial(0, 1.3, origin="covering"), *(trial(k, 0.5) for k in range(1, 9))]
    verdict = judge_by(certificate, trials, 1.2, volume=options.left_out, kind=Dynamics(share=SHARE))
    assert verdict.answer == "validated"
    assert judge_by(certificate, trials, 1.2, kind=Dynamics()).answer == "falsified"


def test_independent_draws_above_the_threshold_raise_what_tests_alone_say() -> None:
    origins: list[Origin] = ["iid"] * 30
    distances = np.array([1.3, *np.full(29, 0.5)])
    sample = Sample(np.random.default_rng(0).random((30, 2)), distances, origins, ["completed"] * 30, threshold=1.2)
    tests = certify_dynamics(sample, replace(GOOD, target=Share(SHARE), threshold=1.2)).details["tests"]
    none = certify_dynamics(
        replace(sample, distances=np.full(30, 0.5)), replace(GOOD, target=Share(SHARE), threshold=1.2)
    )
    assert tests["above"] == 1
    chosen = certify_dynamics(
        replace(sample, origins=["covering"] * 30), replace(GOOD, target=Share(SHARE), threshold=1.2)
    )
    assert chosen.details["tests"]["share_missed"] is None
    assert tests["share_missed"] > none.details["tests"]["share_missed"]


def test_options_beside_a_certificate_are_refused() -> None:
    with pytest.raises(InputError):
        CertificateOptions.or_automatic(CertificateOptions(), 0.95, 0.125, 0.99)
    with pytest.raises(InputError):
        Automatic(share=0.2)
