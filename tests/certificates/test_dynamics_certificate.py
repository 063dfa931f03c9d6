"""The bound from learned dynamics, from evidence in plain numbers: its order statistic, its texts and its verdicts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import TaskSpace, Trial
from ctxval.certificates import (
    KINDS,
    Automatic,
    CertificateKind,
    CertificateOptions,
    DistanceBound,
    Dynamics,
    Evidence,
    Forecast,
    Learned,
    Provenance,
    Sample,
    certify_dynamics,
)
from ctxval.certificates.bounds import NO_UNITS
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.sentences.verdicts import undecided
from ctxval.certificates.verdict import judge, judge_by
from ctxval.core.coverage import UntestedRest, UnvisitedRegion
from ctxval.core.learned_numbers import PushedDistances
from ctxval.errors import CertificateError
from facts import assert_names, refuses
from rig_evidence import COVERED, GOOD, gap, prediction
from rig_thorough import more


def trials(count: int = 4, largest: float = 0.8) -> list[Trial]:
    points = np.random.default_rng(2).random((count, 2))
    distances = np.linspace(0.1, largest, count)
    return [
        Trial(k, "acquisition", "completed", points[k], {"a": 0.0}, 1, True, float(distances[k])) for k in range(count)
    ]


def sample(evidence: Evidence | None = GOOD, count: int = 4) -> Sample:
    return replace(Sample.of(trials(count)), learned=Learned(evidence))


def test_the_bound_is_the_order_statistic_of_the_maxima() -> None:
    found = certify_dynamics(sample(), GOOD)
    assert found.doubt is None
    assert found.upper_bound == np.sort(GOOD.maxima)[38]  # 39 of 41 are 0.951
    assert certify_dynamics(sample(), replace(GOOD, confidence=0.9)).upper_bound == np.sort(GOOD.maxima)[36]
    with refuses(CertificateError, 40):
        certify_dynamics(sample(), replace(GOOD, confidence=0.99))


def test_draws_that_disagree_on_the_bound_leave_an_error_that_counts() -> None:
    assert certify_dynamics(sample(), GOOD).error < 0.01
    assert certify_dynamics(sample(), replace(GOOD, maxima=np.full(40, 0.9))).error < 1e-12
    wild = replace(GOOD, maxima=np.append(np.full(37, 0.9), [1.0, 1.0, 9.0]))
    found = certify_dynamics(sample(), wild)
    assert found.upper_bound == 1.0
    assert not found.covers(1.1)


def test_exchangeable_maxima_exceed_the_bound_as_rarely_as_stated() -> None:
    """1e5 truths that are exchangeable with the draws, with any distribution of the maxima."""
    rng = np.random.default_rng(3)
    maxima = rng.lognormal(size=(100_000, 41))
    upper = np.sort(maxima[:, 1:], axis=1)[:, GOOD.rank]
    assert (maxima[:, 0] > upper).mean() == pytest.approx(1 - 39 / 41, abs=0.003)


@given(st.lists(st.tuples(st.floats(0, 2), st.floats(0, 2)), min_size=3, max_size=6), st.floats(0.01, 3))
def test_the_bound_is_never_below_what_was_executed_and_never_lowered_by_a_prediction(
    pairs: list[tuple[float, float]], best: float
) -> None:
    checked = tuple(prediction(k, *pair) for k, pair in enumerate(pairs))
    evidence = replace(GOOD, predictions=checked, best=best)
    assert evidence.bound >= max(best, evidence.upper)
    excess = max(max(distance - median, 0.0) for median, distance in pairs[-LIMITS.predictions :])
    assert evidence.bound == pytest.approx(max(best, evidence.upper) + 0.5 * excess)


def test_a_bound_that_a_diagnostic_withdraws_keeps_no_threshold() -> None:
    found = certify_dynamics(sample(), replace(GOOD, executions=2))
    assert found.withdrawn_by == "few_executions"
    assert not found.covers(1e9)


def test_the_certificate_names_the_check_that_withdraws_it() -> None:
    certificate = certify_dynamics(sample(), replace(GOOD, left_out=0.9))
    assert certificate.withdrawn_by == "left_out"
    assert [each["code"] for each in certificate.details["open_checks"]] == ["left_out"]
    assert certificate.bound is None


def test_a_prediction_that_failed_matters_by_the_margin_to_the_threshold() -> None:
    found = certify_dynamics(sample(), replace(GOOD, predictions=(*GOOD.predictions, prediction(4, 0.6, 0.5))))
    assert found.doubt is None
    assert found.details["raised_from"] == pytest.approx(np.sort(GOOD.maxima)[38])
    assert found.upper_bound == pytest.approx(found.details["raised_from"] + 0.1 / LIMITS.error)
    assert found.covers(3.1)
    assert not found.covers(1.1 * found.details["raised_from"])
    reason = judge_by(found, trials(4), 1.5).reason
    assert_names(reason, 4, 0.5, 0.6, 0.9974)


def test_an_undecided_verdict_says_how_many_executions_are_needed_and_what_the_samples_say() -> None:
    fewer = replace(sample(), learned=Learned(replace(GOOD, predictions=GOOD.predictions[:1])))
    certificate = Dynamics(tests=0).certify(replace(fewer, threshold=1.2))
    assert certificate.doubt is not None
    assert certificate.expected == Forecast(2, 1.0)
    needed = "at least 2 more executions are needed to validate it; so far, 100 % of the posterior samples"
    assert needed in str(certificate.expected)
    assert Dynamics(tests=0).certify(replace(sample(), threshold=1.2)).expected is None


def test_a_draw_that_diverges_leaves_no_bound() -> None:
    diverging = replace(GOOD, maxima=np.append(GOOD.maxima[:-2], [np.inf, np.inf]))
    with refuses(CertificateError):
        certify_dynamics(sample(), diverging)
    one = replace(GOOD, maxima=np.append(GOOD.maxima[:-1], np.inf))
    with refuses(CertificateError):
        certify_dynamics(sample(), one)
    unpredicted = replace(GOOD, predictions=(*GOOD.predictions, prediction(4, np.inf, 0.5)))
    with refuses(CertificateError):
        certify_dynamics(sample(), unpredicted)


def test_many_coordinates_are_said_not_to_be_covered_jointly() -> None:
    wide = replace(COVERED, pair=None, beyond=gap(0.9 * LIMITS.gap))
    found = certify_dynamics(sample(), replace(GOOD, coverage=wide))
    assert found.doubt is None
    assert any("not all combinations" in one for one in found.assumptions)


def test_it_is_raised_by_what_a_deeper_search_finds() -> None:
    usual, raised = (
        certify_dynamics(sample(), replace(GOOD, low_dimensional=True, search_shortfall=one)) for one in (1.0, 1.04)
    )
    assert raised.doubt is None
    assert raised.upper_bound == pytest.approx(1.04 * usual.upper_bound)


def test_it_says_that_the_system_was_learned_without_its_model() -> None:
    found = certify_dynamics(sample(), replace(GOOD, without_model=True))
    assert any("the system is learned without M" in one for one in found.assumptions)
    assert found.details["without_model"] is True
    usual = certify_dynamics(sample(), GOOD)
    assert not any("without M" in one for one in usual.assumptions)
    assert usual.details["without_model"] is False


def test_it_needs_the_model_and_executions_that_did_not_fail() -> None:
    with refuses(CertificateError, "Campaign.verdict"):
        Dynamics().certify(Sample.of(trials()))
    with refuses(CertificateError):
        Dynamics().certify(sample(None))
    failed = [*trials(3), replace(trials(4)[3], state="failed", distance=None, failure="it fell")]
    with refuses(CertificateError, 3):
        Dynamics().certify(replace(Sample.of(failed), learned=Learned(GOOD)))


def test_the_verdict_names_its_evidence() -> None:
    known = Provenance(learned=Learned(GOOD))
    verdict = judge(trials(), 1.1, CertificateOptions(Dynamics(tests=0)), known)
    untested = "validated: no prediction was tested at drawn tasks (tests = 0); every task stays at or below"
    assert str(verdict).startswith(untested)
    assert "if what M misses is one smooth function of recorded state and input" in verdict.reason
    assert verdict.rests_on is not None
    assert "changing neither with time nor with the task" in verdict.rests_on
    assert "the recorded state being complete" in verdict.rests_on


@pytest.mark.parametrize(("other", "validates"), [(0.0, True), (0.01, True), (0.2, False)])
@pytest.mark.parametrize("kind", [Dynamics(tests=0), *more(Automatic(tests=0))])
def test_noise_that_nobody_declared_is_named(other: float, validates: bool, kind: CertificateKind) -> None:
    executed = trials()
    again = replace(executed[2], number=len(executed), distance=(executed[2].distance or 0.0) - other)
    verdict = judge([*executed, again], 1.1, CertificateOptions(kind), Provenance(learned=Learned(GOOD)))
    assert verdict.answer == ("validated" if validates else "undecided")
    assert ("trials 2 and 4" in str(verdict)) == bool(other)
    if not validates:
        assert "the system is not deterministic in the recorded state" in verdict.reason
    elif other:
        assert "the system being deterministic (trials 2 and 4 of one task differ a little)" in str(verdict.rests_on)


def test_a_gate_that_passes_only_in_part_is_support_and_no_validation() -> None:
    part = Learned(replace(GOOD, coverage=replace(COVERED, marginal=gap(0.4))))
    verdict = judge(trials(), 1.1, CertificateOptions(Dynamics(tests=0)), Provenance(learned=part))
    assert verdict.answer == "undecided"
    assert verdict.reason.startswith(
        "supported by the model: no posterior sample of the dynamics exceeds 1.1 in a search of 9000 closed loops; 3 "
        "of the last 3 predictions held; but predicted runs enter a gap in the records of u[0] by 40 %"
    )
    above = judge(trials(), 0.95, CertificateOptions(Dynamics(tests=0)), Provenance(learned=Learned(GOOD)))
    assert above.answer == "undecided"
    assert "d* may be up to" in above.reason


@pytest.mark.usefixtures("few_draws")
def test_auto_uses_the_dynamics_if_they_decide_and_the_distance_otherwise() -> None:
    chosen = CertificateOptions(Automatic(tests=0))
    assert judge(trials(), 1.1, chosen, Provenance(learned=Learned(GOOD))).certificate.kind == "dynamics"  # type: ignore[union-attr]
    noisy = Provenance(learned=Learned(replace(GOOD, noise=0.5, maxima=GOOD.maxima + 1)))
    assert judge(trials(9), 1.1, chosen, noisy).certificate.kind == "posterior"  # type: ignore[union-attr]
    alone = judge(trials(9), 1.1, chosen)
    assert alone.reason == judge(trials(9), 1.1, CertificateOptions(DistanceBound())).reason


@pytest.mark.usefixtures("few_draws")
@pytest.mark.parametrize(
    ("dimension", "held", "kind"), [(2, True, "posterior"), (6, True, "dynamics"), (6, False, "posterior")]
)
def test_auto_says_what_the_dynamics_lack_if_too_many_executions_would_cover_the_tasks(
    dimension: int, held: bool, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed, certify_drawn = [], DistanceBound.certify_drawn
    monkeypatch.setattr(DistanceBound, "certify_drawn", lambda *given: computed.append(1) or certify_drawn(*given))
    points = np.random.default_rng(3).random((9, dimension))
    executed = [replace(trial, unit_point=point) for trial, point in zip(trials(9), points, strict=True)]
    checked = [prediction(k, 0.5 if held else 0.1) for k in range(6)]
    gaps = replace(COVERED, marginal=gap(0.4))
    lacking = replace(GOOD, coverage=gaps, maxima=GOOD.maxima + 1, predictions=tuple(checked))
    verdict = judge(executed, 1.1, CertificateOptions(Automatic(tests=0)), Provenance(learned=Learned(lacking)))
    assert verdict.answer == "undecided"
    assert verdict.certificate is not None
    assert verdict.certificate.kind == kind
    assert bool(computed) == (kind == "posterior")  # what would be withdrawn and is not shown is not computed


def test_the_kinds_are_found_by_name() -> None:
    assert KINDS.find("dynamics") is Dynamics
    assert KINDS.find("auto") is Automatic
    assert KINDS.find("dynamics").needs_model


def test_the_text_is_complete_and_json_has_every_prediction() -> None:
    found = certify_dynamics(sample(), GOOD)
    assert_names(str(found), "95 %", "d*")
    assert "x[0] 0.1, u[0] 0.2" in str(found)
    stored = json.loads(json.dumps(found.to_json(), allow_nan=False))["details"]
    assert [one["trial"] for one in stored["checked"]] == [1, 2, 3]
    assert stored["predictions"] == {"made": 3, "stored_beforehand": 3, "last_ones": 3, "held": 3}


# What a validation survives

PUSHED = PushedDistances(
    {"speed [m/s^2]": 2.0, "angle [rad/s]": 0.5},
    np.array([0.0, 0.5, 1.0, 2.0]),
    np.array([[1.0, 1.2, 1.5, 2.5], [0.5, 0.5, 0.6, np.inf]]),
    np.array([[0.5] * 4] * 2),
)


@pytest.mark.parametrize(
    ("threshold", "state", "push"),
    [
        (1.35, "speed [m/s^2]", 1.5),  # half-way between two sizes
        (1.5, "speed [m/s^2]", 2.0),
        (0.9, "speed [m/s^2]", 0.0),  # any push may do that
    ],
)
def test_the_tolerance_is_the_smallest_push_in_any_state(threshold: float, state: str, push: float) -> None:
    tolerance = PUSHED.tolerance(threshold)
    assert (tolerance.state, tolerance.push) == (state, pytest.approx(push))
    assert tolerance.ratio == pytest.approx(push / tolerance.residual)


def test_a_rollout_that_diverges_exceeds_every_threshold() -> None:
    assert PUSHED.tolerance(100.0).state == "angle [rad/s]"
    assert PUSHED.tolerance(100.0).push == pytest.approx(0.5)  # the last size at which none diverged


def test_no_push_may_suffice() -> None:
    assert np.isinf(PUSHED.tolerance(0.9, away=True).push)


def test_pushed_distances_survive_json() -> None:
    evidence = replace(GOOD, pushed=PUSHED)
    known = Evidence.from_json(json.loads(json.dumps(evidence.to_json())))
    assert known is not None
    assert known.pushed is not None
    np.testing.assert_array_equal(known.pushed.everywhere, PUSHED.everywhere)
    assert known.pushed.residuals == PUSHED.residuals


def test_a_validation_says_what_it_survives() -> None:
    evidence = replace(GOOD, pushed=PUSHED)
    verdict = judge(trials(), 1.35, CertificateOptions(Dynamics(tests=0)), Provenance(learned=Learned(evidence)))
    assert verdict.answer == "validated"
    assert "No tried task exceeds the threshold under a further error of M" in str(verdict)
    assert "1.5 m/s^2 in speed" in str(verdict)


# Where no execution has been


@pytest.mark.parametrize(
    ("pocket", "sentence"),
    [
        (
            UnvisitedRegion(0.2, {"x [m]": 0.55, "y [m]": -0.35}, {"x [m]": 0.2, "y [m]": 0.2}),
            "The least tested place is x 0.55 m, y -0.35 m: predicted runs lead there, and no execution came within "
            "0.2 m.",
        ),
        (
            UnvisitedRegion(0.1, {"angle [rad]": 1.0, "z": 2.0}, {"angle [rad]": 0.3, "z": 4.0}),
            "The least tested place is angle 1 rad, z 2: predicted runs lead there, and no execution came within 0.3 "
            "rad in angle and 4 in z.",
        ),
    ],
)
def test_a_validation_names_the_largest_region_that_no_execution_has_entered(
    pocket: UnvisitedRegion, sentence: str
) -> None:
    evidence = replace(GOOD, unvisited_region=pocket)
    known = Evidence.from_json(json.loads(json.dumps(evidence.to_json())))
    assert known is not None
    assert known.unvisited_region == pocket
    verdict = judge(trials(), 1.35, CertificateOptions(Dynamics(tests=0)), Provenance(learned=Learned(known)))
    assert verdict.certificate is not None
    assert verdict.certificate.details["unvisited_region"]["within"] == pocket.within
    assert sentence in str(verdict)


def test_a_place_of_a_position_that_no_execution_has_entered_withdraws_the_bound() -> None:
    pocket = UnvisitedRegion(
        0.2, {"x [m]": 0.55, "y [m]": -0.35}, {"x [m]": 0.2, "y [m]": 0.2}, ((0.5, 0.5), (0.1, 0.9))
    )
    evidence = replace(GOOD, unvisited_region=pocket)
    known = Evidence.from_json(json.loads(json.dumps(evidence.to_json())))
    assert known is not None
    assert known.unvisited_region == pocket
    verdict = judge(trials(), 1.35, CertificateOptions(Dynamics(tests=0)), Provenance(learned=Learned(known)))
    assert verdict.answer == "undecided"
    assert_names(verdict.reason, "0.2 m", "x 0.55 m", "y -0.35 m")
    small = replace(evidence, unvisited_region=replace(pocket, size=0.1))
    verdict = judge(trials(), 1.35, CertificateOptions(Dynamics(tests=0)), Provenance(learned=Learned(small)))
    assert verdict.answer == "validated"


def test_a_stretch_where_friction_at_rest_is_untested_withdraws_a_bound_that_it_could_exceed() -> None:
    rest = UntestedRest(0.3, {"x [m]": 0.5}, 0.6, 0.7, 3.0, 2.0, ((0.5, 0.6), (0.1, 0.2)))
    evidence = replace(GOOD, untested_rest=rest)
    known = Evidence.from_json(json.loads(json.dumps(evidence.to_json())))
    assert known is not None
    assert known.untested_rest == rest

    def answer(rest: UntestedRest) -> str:
        learned = Learned(replace(GOOD, untested_rest=rest))
        return judge(trials(), 1.35, CertificateOptions(Dynamics(tests=0)), Provenance(learned=learned)).answer

    assert answer(rest) == "undecided"
    assert answer(replace(rest, size=UntestedRest.MOST)) == "validated"
    assert answer(replace(rest, highest=1.35)) == "validated"


def test_a_validation_names_the_largest_box_of_two_parameters_without_an_execution() -> None:
    space = TaskSpace(shelf=(0.0, 2.0, "m"), size=(0.0, 10.0))
    points = np.array([[0.5, 0.2], [0.1, 0.9], [0.9, 0.5], [0.1, 0.95]])
    executed = [replace(trial, unit_point=point) for trial, point in zip(trials(), points, strict=True)]
    known = Provenance(learned=Learned(GOOD), space=space)
    verdict = judge(executed, 1.35, CertificateOptions(Dynamics(tests=0)), known)
    assert_names(str(verdict), "shelf", 0.2, 1.8, "size", 2, 10, "64 %")


def test_without_a_pocket_nothing_is_said_of_one() -> None:
    verdict = judge(trials(), 1.35, CertificateOptions(Dynamics(tests=0)), Provenance(learned=Learned(GOOD)))
    assert "No execution" not in str(verdict)


def test_an_undecided_verdict_names_the_parameter_that_dynamics_seem_to_depend_on() -> None:
    certificate = Dynamics().certify(sample(replace(GOOD, suspect=("load", 2.4))))
    sentence = undecided(certificate, 0.5 * certificate.upper_bound, 0.0, NO_UNITS)
    assert_names(sentence, "load", 2.4, 'physical = ["load"]')
    assert "physical" not in undecided(Dynamics().certify(sample()), 0.1, 0.0, NO_UNITS)
