from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from ctxval import TaskSpace, Trial
from ctxval.certificates import (
    AnytimeAudit,
    Audit,
    Certificate,
    CertificateKind,
    CertificateOptions,
    DistanceBound,
    Neighbour,
    Provenance,
    Sample,
    Scenario,
)
from ctxval.certificates.covering import RESOLUTION, resolved_volume
from ctxval.certificates.sentences.withdrawals import REFINED
from ctxval.certificates.stopping import StoppingRule
from ctxval.certificates.verdict import counterexample, judge, judge_by
from ctxval.core.trial import Origin, State, StatedThreshold, designs_sentence
from ctxval.core.trial_note import TrialNote
from ctxval.errors import InputError
from facts import assert_names, refuses

pytestmark = pytest.mark.usefixtures("few_draws")

WORST = 1.0


def posterior(confidence: float = 0.95, resolution: float = RESOLUTION) -> CertificateOptions:
    return CertificateOptions(DistanceBound(resolution), confidence)


def trial(
    number: int, x: float, distance: float | None, origin: Origin = "acquisition", state: State | None = None
) -> Trial:
    ended: State = state or ("failed" if distance is None else "completed")
    return Trial(number, origin, ended, np.array([x]), {"x": x}, 1, ended != "open", distance)


def trials(n: int = 8, origin: Origin = "acquisition") -> list[Trial]:
    """A bump of height 1, known at n even points."""
    return [trial(k, x, WORST * np.sin(3 * x)) for k, x in enumerate(np.linspace(0, 1.0, n).tolist())]


def certificate(upper: float, doubt: str | None = None, volume: float = 0.0) -> Certificate:
    return Certificate("posterior", "", upper, 0.95, volume, 5, (), doubt=doubt)


# Counterexamples


def test_the_steps_before_a_failure_falsify_until_a_success_makes_it_good() -> None:
    stopped = replace(trial(8, 0.35, None), note=TrialNote(at_least=0.7), failure="emergency stop")
    low = [replace(each, distance=0.1) for each in trials()]
    verdict = judge([*low, stopped], 0.5)
    assert (verdict.answer, verdict.witness) == ("falsified", stopped)
    assert_names(verdict.reason, "trial", 8, "distance", 0.7)
    assert "--again 8 --because" in verdict.reason
    assert judge([*low, stopped], 0.8).answer == "undecided"
    assert judge([*low, stopped, replace(trial(9, 0.35, 0.1), because="fuse replaced")], 0.5).answer != "falsified"
    # A whole execution is the better counterexample.
    whole = counterexample([*low, stopped, trial(9, 0.9, 0.6)], 0.5)
    assert whole is not None
    assert whole.witness is not None
    assert whole.witness.number == 9


def test_an_executed_distance_above_the_threshold_falsifies() -> None:
    known = trials()
    largest = max(t.distance or 0.0 for t in known)
    found = counterexample(known, 0.5)
    assert found is not None
    assert found.answer == "falsified"
    assert found.witness is not None
    assert found.witness.distance == largest
    assert_names(str(found), "distance", found.witness.number)
    assert str(found).startswith("falsified: ")


def test_a_distance_at_the_threshold_is_no_counterexample_and_neither_is_a_failure() -> None:
    known = [trial(0, 0.1, 0.5), trial(1, 0.2, None), trial(2, 0.3, None, state="open")]
    assert counterexample(known, 0.5) is None
    assert counterexample(known, np.nextafter(0.5, 0)) is not None
    assert counterexample([], 0.5) is None


@pytest.mark.parametrize("threshold", [0.0, -1.0, np.nan, np.inf, "1", None])
def test_a_threshold_is_a_positive_number(threshold: object) -> None:
    with refuses(InputError, "threshold"):
        counterexample([], threshold)  # type: ignore[arg-type]
    for function in (counterexample, judge, lambda known, tau: StoppingRule(tau).decide(known, 0)):
        with refuses(InputError, "threshold"):
            function(trials(), threshold)  # type: ignore[operator]


# Designs of the controllers


def with_notes(notes: list[dict[str, object]]) -> list[Trial]:
    return [replace(one, note=TrialNote.from_json(note)) for one, note in zip(trials(len(notes)), notes, strict=True)]


def test_a_verdict_says_at_how_many_executed_tasks_the_design_did_not_converge() -> None:
    known = with_notes([{"converged": True}, {"converged": False}, {"converged": False, "unsteady": 2}, {}])
    sentence = (
        "the design of the controller did not converge at 2 of 3 executed tasks, among them the worst one; 2 tasks "
        "were not executed, because the controller jumps if the task changes by 1e-9 of its range"
    )
    worst = replace(known[2], distance=5.0)
    for threshold, answer in ((0.5, "falsified"), (50.0, "undecided")):
        found = judge([known[0], known[1], worst, known[3]], threshold)
        assert found.answer == answer
        assert found.reason.endswith(f"; {sentence}.")
    other = replace(known[0], distance=9.0)
    assert designs_sentence([other, *known[1:]]) == sentence.replace(", among them the worst one", "")


@pytest.mark.parametrize("notes", [[{}] * 3, [{"converged": True}] * 3, [{"unsteady": "many"}, {}, {}]])
def test_a_verdict_says_nothing_of_designs_that_converged(notes: list[dict[str, object]]) -> None:
    assert designs_sentence(with_notes(notes)) is None
    assert "design" not in judge(with_notes(notes), 0.1).reason


def test_the_designs_of_open_trials_do_not_count() -> None:
    waiting = replace(trial(0, 0.1, None, state="open"), note=TrialNote(converged=False))
    assert designs_sentence([waiting]) is None


# By a certificate


def test_a_bound_at_most_the_threshold_validates() -> None:
    verdict = judge_by(certificate(1.2), trials(), 1.2)
    assert verdict.answer == "validated"
    assert verdict.certificate is not None
    assert_names(verdict.reason, 95)


def test_a_counterexample_wins_over_any_bound() -> None:
    verdict = judge_by(certificate(0.1), trials(), 0.5)
    assert verdict.answer == "falsified"
    assert verdict.witness is not None
    assert verdict.certificate is not None


def test_a_bound_above_the_threshold_leaves_it_undecided() -> None:
    verdict = judge_by(certificate(1.3), trials(), 1.2)
    assert verdict.answer == "undecided"
    assert_names(verdict.reason, 1.3)


def test_a_withdrawn_bound_validates_nothing() -> None:
    verdict = judge_by(certificate(1.1, doubt="trial 3 is too large"), trials(), 1.2)
    assert verdict.answer == "undecided"
    assert_names(verdict.reason, 3)


def test_a_volume_is_left_out_only_where_that_is_accepted() -> None:
    partial = certificate(1.1, volume=0.05)
    refused = judge_by(partial, trials(), 1.2)
    assert refused.answer == "undecided"
    assert_names(refused.reason, 5)
    assert judge_by(partial, trials(), 1.2, volume=0.04).answer == "undecided"
    accepted = judge_by(partial, trials(), 1.2, volume=0.05)
    assert accepted.answer == "validated"
    assert_names(accepted.reason, 5, 1.2)


def test_scenario_and_audit_bounds_judge_too() -> None:
    drawn = [trial(k, x, 0.5 * x, "iid") for k, x in enumerate(np.linspace(0, 1, 60).tolist())]
    for made in (Scenario().certify(Sample.of(drawn), 0.9), Audit().certify(Sample.of(drawn), 0.9)):
        assert judge_by(made, drawn, 0.6).answer == "undecided"
        assert judge_by(made, drawn, 0.6, volume=0.05).answer == "validated"
        assert judge_by(made, drawn, 0.4, volume=0.05).answer == "falsified"


# By the posterior


def test_the_posterior_bound_validates_what_is_far_above_it() -> None:
    verdict = judge(trials(), 50.0, posterior())
    assert verdict.answer == "validated"
    assert verdict.certificate is not None
    assert verdict.certificate.kind == "posterior"
    assert verdict.expected is None


def test_a_counterexample_needs_no_certificate_and_no_model() -> None:
    known = [*trials(3), trial(3, 0.7, None), trial(4, 0.8, None, state="open")]
    assert judge(known, 0.5).answer == "falsified"
    assert StoppingRule(0.5).decide(known, 0).decided


@pytest.mark.slow
def test_undecided_says_what_more_would_take() -> None:
    known = trials(5)
    upper = DistanceBound().certify(Sample.of(known)).upper_bound
    tau = 0.5 * (upper + max(t.distance or 0.0 for t in known))
    verdict = judge(known, tau)
    assert verdict.answer == "undecided"
    assert not StoppingRule(tau).decide(known, 0).decided


@pytest.mark.slow
def test_a_bound_that_is_withdrawn_is_not_forecast() -> None:
    known = [*trials(25), trial(25, 0.51, 30.0)]
    verdict = judge(known, 1e6)
    assert verdict.answer == "undecided"
    assert "withdrawn" in verdict.reason
    assert verdict.expected is None
    assert not StoppingRule(1e6).decide(known, 0).decided


@pytest.mark.parametrize(
    ("known", "facts"),
    [
        ([], ()),
        (trials(3), (4,)),
        ([*trials(), trial(8, 0.4, None)], (1, 9)),
        ([*trials(), trial(8, 0.4, None, state="open")], (8,)),
        ([trial(k, k / 9, 0.3) for k in range(9)], ("d*",)),
    ],
)
def test_where_nothing_can_be_certified_the_verdict_is_open_and_says_why(
    known: list[Trial], facts: tuple[object, ...]
) -> None:
    verdict = judge(known, 5.0)
    assert verdict.answer == "undecided"
    assert_names(verdict.reason, *facts)
    assert any(one.state == "open" for one in known) or not StoppingRule(5.0).decide(known, 0).decided


def test_a_confidence_beyond_the_draws_is_undecided_and_one_that_is_none_is_refused() -> None:
    verdict = judge(trials(), 50.0, posterior(1 - 1e-9))
    assert verdict.answer == "undecided"
    for tau, confidence in ((50.0, 1.5), (0.5, 0.0)):
        with refuses(InputError, 0.5, 1):
            judge(trials(), tau, posterior(confidence))
        with refuses(InputError, 0.5, 1):
            StoppingRule(tau, confidence).decide(trials(), 0)


def repeated(executed: Trial) -> Trial:
    """Return another execution of a task, whose distance is another one because of noise."""
    return replace(executed, number=99, distance=1.05 * (executed.distance or 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("stochastic", [False, True])
@pytest.mark.thorough
def test_decided_is_what_the_verdict_is_not_undecided_of(stochastic: bool) -> None:
    known = [*trials(6), *([repeated(trials(6)[2])] if stochastic else [])]
    upper = DistanceBound().certify(Sample.of(known), 0.95).upper_bound
    best = max(t.distance or 0.0 for t in known)
    for threshold in (0.9 * best, 1.02 * upper, best + 0.2 * (upper - best)):
        verdict = judge(known, threshold, posterior())
        assert StoppingRule(threshold).decide(known, 0).decided == (verdict.answer != "undecided")


@pytest.mark.slow
def test_what_nothing_came_near_to_is_missing_where_the_bound_keeps_the_threshold() -> None:
    known = [one for one in trials(9) if not 0.3 < one.unit_point[0] < 0.7]
    now = StoppingRule(50.0).decide(known, left=1)
    assert not now.decided
    assert now.next_point is not None
    assert now.next_point[0] == pytest.approx(0.5, abs=0.01)
    assert_names(judge(known, 50.0).reason, 1)
    # Being executed is as good as covered.
    pending = [*known, trial(9, 0.5, None, state="open")]
    challenged = StoppingRule(50.0).decide(pending, left=1)
    assert challenged.next_point is not None
    assert abs(challenged.next_point[0] - 0.5) > 0.01
    # Neither where the budget does not suffice, nor where the bound is too high, is an execution spent on it.
    assert StoppingRule(50.0).decide(known, left=0).next_point is None
    assert StoppingRule(max(t.distance or 0.0 for t in known) * 1.0001).decide(known, left=1).next_point is None


def test_a_reason_does_not_round_its_comparison_away() -> None:
    falsified = counterexample([trial(0, 0, 0.50000001)], 0.5)
    assert falsified is not None
    assert_names(falsified.reason, 0.50000001, 0.5)
    near = judge_by(certificate(1.234561), trials(), 1.234569).reason
    assert_names(near, 1.234569, 1.234561)
    assert_names(judge_by(certificate(1.23457), trials(), 1.23456).reason, 1.23456, 1.235)


@pytest.mark.parametrize("resolution", [np.nan, 0.0, -0.1, np.inf])
def test_a_resolution_that_is_no_positive_number_is_refused_before_anything_is_said(resolution: float) -> None:
    for trials_of in (trials(), [trial(0, 0.5, 9.0)]):  # a counterexample among them or not
        with refuses(InputError, "resolution"):
            judge(trials_of, 1.0, posterior(resolution=resolution))
        with refuses(InputError, "resolution"):
            StoppingRule(1.0, resolution=resolution).decide(trials_of, 5)


def test_a_failure_that_was_made_good_counts_no_more() -> None:
    known = trials()
    failed = trial(len(known), 0.31, None, state="failed")
    again = trial(len(known) + 1, 0.31, WORST * np.sin(3 * 0.31))
    failed_later = [*known, replace(again, number=len(known)), replace(failed, number=99)]
    for not_made_good in ([*known, failed], failed_later):
        assert "executions failed" in judge(not_made_good, 1e3).reason
    by = posterior()
    made_good, never_failed = judge([*known, failed, again], 1e3, by), judge([*known, again], 1e3, by)
    assert (made_good.answer, never_failed.answer) == ("undecided", "validated")
    assert_names(made_good.reason, "reason")
    explained = judge([*known, failed, replace(again, because="fuse replaced")], 1e3, by)
    assert explained.answer == "validated"
    assert explained.rests_on is not None
    assert_names(explained.rests_on, "trial", 8)
    assert made_good.certificate is not None
    assert never_failed.certificate is not None
    assert made_good.certificate.upper_bound == never_failed.certificate.upper_bound
    sample = Sample.of([*known, failed, again])
    assert list(sample.numbers) == [*range(len(known)), len(known) + 1]


def test_a_failed_draw_stays_one_whatever_came_later() -> None:
    drawn = [*trials(origin="iid"), trial(8, 0.31, None, state="failed", origin="iid"), trial(9, 0.31, 0.1)]
    assert Sample.of(drawn).failed == 1


# What a verdict promises, in its own line


@pytest.mark.parametrize("confidence", [0.1, 0.49])
def test_a_confidence_below_a_half_is_refused(confidence: float) -> None:
    with refuses(InputError, "confidence", 0.5):
        judge(trials(), 50.0, posterior(confidence))
    with refuses(InputError, "confidence", 0.5):
        StoppingRule(50.0, confidence).decide(trials(), 0)
    with refuses(InputError, "confidence", 0.5):
        judge_by(replace(certificate(1.0), confidence=confidence), trials(), 50.0)


def test_a_volume_of_most_of_the_tasks_is_refused() -> None:
    with refuses(InputError, "volume", 0.99):
        judge_by(certificate(1.0, volume=0.05), trials(), 1.2, volume=0.99)


IN_SPACE = Provenance(TaskSpace(goal=(0.0, 2.0, "rad")))


def test_a_resolution_other_than_the_usual_one_stands_in_the_verdict_in_the_units_of_the_task() -> None:
    usual = judge(trials(), 50.0, provenance=IN_SPACE)
    assert "diagonals" not in usual.reason
    coarse = judge(trials(), 50.0, posterior(resolution=0.25), IN_SPACE)
    assert_names(coarse.reason, 0.5, 50, "diagonals", "usual")
    assert_names(judge(trials(), 50.0, posterior(resolution=0.25)).reason, 0.25, 50)
    none = judge(trials(), 50.0, posterior(resolution=1), IN_SPACE)
    assert_names(none.reason, "diagonals", "usual")


def test_a_quarter_of_the_diagonal_is_39_percent_of_a_plane() -> None:
    assert resolved_volume(0.25, 2) == pytest.approx(0.3927, abs=1e-4)
    assert resolved_volume(0.125, 1) == pytest.approx(0.25)
    assert resolved_volume(0.125, 3) == pytest.approx(4 / 3 * np.pi * (0.125 * np.sqrt(3)) ** 3)
    assert resolved_volume(1.0, 2) == 1.0


def test_a_validation_names_what_it_rests_on() -> None:
    verdict = judge(trials(), 50.0, posterior(), IN_SPACE)
    assert_names(verdict.rests_on, 8, 0.9897, "trials", 0.25)
    assert verdict.rests_on in str(verdict)
    noisy = judge([*trials(), repeated(trials()[2])], 50.0, posterior(), IN_SPACE)
    assert noisy.rests_on is not None
    assert judge(trials(), 0.5).rests_on is None
    drawn = [trial(k, x, 0.5 * x, "iid") for k, x in enumerate(np.linspace(0, 1, 60).tolist())]
    audited = judge_by(Audit().certify(Sample.of(drawn), 0.9), drawn, 0.6, volume=0.05)
    assert audited.rests_on is not None
    assert_names(audited.rests_on, 3.77)


def test_a_threshold_within_the_error_of_the_bound_is_undecided() -> None:
    near = replace(certificate(1.0), error=0.05)
    for threshold in (1.0, 1.09):
        verdict = judge_by(near, trials(), threshold)
        assert verdict.answer == "undecided"
        assert_names(verdict.reason, 1, 0.05)
        assert_names(verdict.reason, "near")
    judge_by(near, trials(), 1.09)
    assert judge_by(near, trials(), 1.11).answer == "validated"
    assert_names(judge_by(near, trials(), 1.11).reason, 1.11, 1, 0.05)


def test_the_error_is_in_the_verdict_of_the_posterior() -> None:
    verdict = judge(trials(5), 50.0, posterior(resolution=1))
    assert verdict.certificate is not None
    assert verdict.certificate.error > 0
    assert "±" in verdict.reason


def test_sentences_have_units_and_tasks() -> None:
    known = replace(IN_SPACE, units="m")
    validated = judge(trials(), 50.0, posterior(), known)
    assert_names(validated.reason, 50, "m", "posterior")
    assert_names(str(validated), 8, "distance", 0.9897, "m")
    executed = trials()
    falsified = judge(executed, 0.5, posterior(), known)
    assert_names(falsified.reason, "m", 0.5, 1.143, "executed")
    close = replace(executed[0], number=9, unit_point=executed[4].unit_point, distance=executed[4].distance)
    for more, facts in (
        ([close], ()),
        ([close, replace(close, number=10)], ()),
        ([replace(close, distance=0.1)], ()),
    ):
        assert_names(judge([*executed, *more], 0.5, posterior(), known).reason, *facts)


def test_a_validation_rests_on_what_the_user_states() -> None:
    known = Provenance(remarks=("what was changed after 7 trials makes no difference to them", REFINED))
    verdict = judge(trials(), 50.0, posterior(), known)
    assert verdict.rests_on is not None
    assert_names(verdict.rests_on, 7, "trials")
    assert REFINED not in verdict.rests_on


@pytest.mark.parametrize(
    ("others", "facts"),
    [
        ([], ()),
        ([0.4], ("beside",)),
        ([60.0], ("beside", "s0.sqlite")),
        ([0.4, None], ("beside",)),
        ([60.0, 0.4], ("beside", 1, "s0.sqlite")),
        ([60.0, 70.0, 1.0], ("beside", 2, "s0.sqlite", "s1.sqlite")),
    ],
)
def test_a_validation_counts_the_campaigns_of_the_experiment(
    others: list[float | None], facts: tuple[object, ...]
) -> None:
    worst = (None if distance is None else trial(3, 0.5, distance) for distance in others)
    beside = tuple(Neighbour(Path(f"runs/s{k}.sqlite"), each) for k, each in enumerate(worst))
    verdict = judge(trials(), 50.0, posterior(), replace(IN_SPACE, beside=beside, units="m"))
    assert verdict.answer == "validated"
    assert_names(str(verdict.rests_on), *facts)
    above = [k for k, distance in enumerate(others) if (distance or 0.0) > 50]
    assert ("falsif" in verdict.reason) == bool(above)
    for k in above:
        assert_names(verdict.reason, "trial", 3, "distance", "m", k)
    undecided = judge(trials(3), 50.0, posterior(), replace(IN_SPACE, beside=beside))
    assert ("falsif" in undecided.reason) == bool(above)


def test_a_threshold_chosen_after_looking_is_said_in_the_sentence() -> None:
    stated = StatedThreshold(0.5, 0), StatedThreshold(0.995, 4), StatedThreshold(50.0, 7), StatedThreshold(0.9, 7)
    verdict = judge(trials(), 50.0, posterior(), Provenance(thresholds=stated))
    assert_names(verdict.reason, "stated", 7, 0.5, 0.995)
    assert_names(str(verdict.rests_on), 7)
    never = judge(trials(), 49.0, posterior(), Provenance(thresholds=stated)).reason
    assert_names(never, 8, "thresholds", 0.5, 0.9)
    one = judge(trials(), 50.0, posterior(), Provenance(thresholds=(StatedThreshold(50.0, 1),)))
    assert_names(one.reason, 1)
    assert_names(str(one.rests_on), 1)
    for silent in (None, (StatedThreshold(50.0, 0),)):
        assert "stated" not in str(judge(trials(), 50.0, posterior(), Provenance(thresholds=silent)))


def test_most_kinds_are_handed_countable_draws_only() -> None:
    drawn = [replace(trial(k, k / 5, 0.1, "iid"), note=TrialNote(draws=3 if k < 3 else 6)) for k in range(6)]
    for kind, count in ((Share(), 3), (Audit(), 3), (AnytimeAudit(), 6)):
        verdict = judge(drawn, 0.5, CertificateOptions(kind, 0.5, 0.5))
        assert verdict.certificate is not None
        assert verdict.certificate.trials == count


@dataclass(frozen=True)
class Share(CertificateKind):
    """Count all independent draws that it is given."""

    name: ClassVar[str] = "share"

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return a certificate of the draws."""
        draws = len(sample.only("iid"))
        return Certificate(self.name, "", sample.best, confidence, 1 / draws, draws, ())


def test_remarks_are_among_the_assumptions() -> None:
    verdict = judge(trials(), 50.0, provenance=Provenance(remarks=("S was changed after trial 3: oil",)))
    assert verdict.certificate is not None
    assert_names(verdict.certificate.assumptions[-1], 3)
