from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import make_validation
from ctxval import Campaign, Trial, searches
from ctxval.certificates import (
    Audit,
    Certificate,
    Sample,
    SamplingDiscarding,
    Scenario,
    samples_needed,
    tail,
    volume_bound,
)
from ctxval.errors import CertificateError, InputError
from facts import assert_names, refuses
from rig_thorough import more

DRAWS = 100_000
betas = st.floats(1e-6, 0.5)
volumes = st.floats(1e-3, 0.5)


def scenario(sample: Sample, confidence: float = 0.95, discarded: int = 0) -> Certificate:
    kind = SamplingDiscarding(discarded) if discarded else Scenario()
    return kind.certify(sample, confidence)


def sample(distances: list[float], origin: str = "iid") -> Sample:
    n = len(distances)
    states = ["failed" if np.isnan(d) else "completed" for d in distances]
    return Sample(np.full((n, 2), 0.5), np.array(distances), [origin] * n, states)  # type: ignore[list-item, arg-type]


@pytest.mark.parametrize(("n", "discarded"), [(10, 0), (20, 1), (60, 5), (100, 5)])
@pytest.mark.parametrize("volume", [0.02, 0.05, 0.1])
def test_the_tail_is_the_simulated_one_and_the_papers_sum_is_not(n: int, discarded: int, volume: float) -> None:
    # With uniform d, the volume above the (k+1)-th largest of n draws is one minus it.
    rng = np.random.default_rng([n, discarded])
    kept = np.partition(rng.random((DRAWS, n)), n - 1 - discarded, axis=1)[:, n - 1 - discarded]
    simulated = (1 - kept > volume).mean()
    exact = tail(n, discarded, volume)
    assert abs(simulated - exact) < 4.5 * np.sqrt(exact * (1 - exact) / DRAWS) + 1e-5
    printed = tail(n, discarded - 1, volume) if discarded else 0.0
    if exact - printed > 0.01:
        assert abs(simulated - printed) > 4.5 * np.sqrt(exact * (1 - exact) / DRAWS)


@given(volumes, betas)
def test_without_discarding_the_number_needed_is_the_closed_form(volume: float, beta: float) -> None:
    n = samples_needed(volume, beta)
    assert (1 - volume) ** n <= beta * (1 + 1e-9)
    assert n == 1 or (1 - volume) ** (n - 1) > beta * (1 - 1e-9)


@given(st.integers(1, 400), st.integers(0, 10), betas)
def test_the_volume_bound_inverts_the_tail(n: int, discarded: int, beta: float) -> None:
    if discarded < n:
        assert tail(n, discarded, volume_bound(n, discarded, beta)) == pytest.approx(beta, rel=1e-6)


@given(st.integers(12, 300), st.integers(0, 10), betas)
def test_more_samples_never_widen_and_more_confidence_or_discarding_never_tighten(n: int, k: int, beta: float) -> None:
    bound = volume_bound(n, k, beta)
    assert volume_bound(n + 1, k, beta) <= bound + 1e-12
    assert volume_bound(n, k, beta / 2) >= bound - 1e-12
    assert volume_bound(n, k + 1, beta) >= bound - 1e-12


@given(volumes, betas, st.integers(0, 6))
def test_the_number_needed_is_the_least(volume: float, beta: float, discarded: int) -> None:
    n = samples_needed(volume, beta, discarded)
    assert tail(n, discarded, volume) <= beta
    assert n == discarded + 1 or tail(n - 1, discarded, volume) > beta


@pytest.mark.parametrize("discarded", [3, *more(0)])
def test_the_stated_confidence_is_the_measured_coverage(discarded: int) -> None:
    rng = np.random.default_rng(discarded)
    held, runs, n = 0, 1500, 40
    for _ in range(runs):
        certificate = scenario(sample(rng.random(n).tolist()), 0.9, discarded)
        held += 1 - certificate.upper_bound <= certificate.volume
    assert abs(held / runs - 0.9) < 4.5 * np.sqrt(0.09 / runs)


def test_a_certificate_says_everything() -> None:
    certificate = scenario(sample([0.1, 0.4, 0.2]), 0.95)
    assert isinstance(certificate, Certificate)
    assert certificate.upper_bound == 0.4
    assert certificate.volume == pytest.approx(1 - 0.05 ** (1 / 3))
    assert certificate.to_json()["kind"] == "scenario"
    assert certificate.covers(0.4, volume=0.7)
    assert not certificate.covers(0.4, volume=0.6)
    assert not certificate.covers(0.39, volume=0.7)
    assert not certificate.covers(0.4)


def test_a_failed_execution_counts_as_a_violation() -> None:
    with refuses(CertificateError, 1, 3):
        scenario(sample([0.1, np.nan, 0.3]))
    assert scenario(sample([0.1, np.nan, 0.3]), discarded=1).upper_bound == 0.3


@pytest.mark.parametrize("origin", ["acquisition", "initial", "manual"])
def test_adaptive_trials_are_refused(origin: str) -> None:
    with refuses(CertificateError, "--search", "--kind"):
        scenario(sample([0.1, 0.2], origin))


@pytest.mark.parametrize(("confidence", "discarded"), [(0.0, 0), (1.0, 0), (1.5, 0), (0.9, -1), (0.9, 2)])
def test_nonsense_is_refused(confidence: float, discarded: int) -> None:
    with pytest.raises((CertificateError, InputError)):
        scenario(sample([0.1, 0.2]), confidence, discarded)


def test_open_trials_and_unequal_parts_are_refused() -> None:
    with refuses(CertificateError, "open", 0):
        Sample(np.zeros((1, 1)), np.zeros(1), ["iid"], ["open"])
    with refuses(CertificateError, "planned"):
        Sample(np.zeros((2, 1)), np.zeros(1), ["iid"], ["completed"])


# The audit


def mixed(adaptive: list[float], drawn: list[float]) -> Sample:
    found = np.array([*adaptive, *drawn])
    origins = ["acquisition"] * len(adaptive) + ["iid"] * len(drawn)
    states = ["failed" if np.isnan(d) else "completed" for d in found]
    return Sample(np.full((len(found), 1), 0.5), found, origins, states)  # type: ignore[arg-type]


def test_an_audit_bounds_the_volume_above_the_worst_of_all_trials() -> None:
    certificate = Audit().certify(mixed([0.9, 0.2], [0.1, 0.3, 0.5]), 0.9)
    assert certificate.upper_bound == 0.9
    assert certificate.volume == pytest.approx(1 - 0.1 ** (1 / 3))
    assert certificate.trials == 3
    assert certificate.details == {
        "largest_found": 0.9,
        "largest_drawn": 0.5,
        "largest_chosen": 0.9,
        "exceeding": 0,
        "not_counted": 0,
        "failed": 0,
        "failures": {"failed": [], "unmeasured": [], "made_good": []},
    }
    assert Audit().certify(mixed([0.4, np.nan], [0.1, 0.5])).details["failed"] == 1
    assert Audit().certify(mixed([0.4, np.nan], [0.1, 0.5, 0.6])).details["exceeding"] == 2
    assert Audit().certify(mixed([], [0.1, 0.5])).details["exceeding"] is None
    assert not certificate.covers(1.0)  # it is no bound on d*
    assert certificate.covers(1.0, volume=0.6)


@pytest.mark.parametrize("head_start", ["none", "random", "after looking"])
def test_the_audits_statement_holds_after_adaptive_search(head_start: str) -> None:
    # With uniform d, the volume above h is 1 - h.
    n, confidence = 30, 0.9
    rng = np.random.default_rng(len(head_start))
    audited = rng.random((DRAWS, n)).max(axis=1)
    searched = {
        "none": np.zeros(DRAWS),
        "random": rng.random((DRAWS, 3)).max(axis=1),
        # A search that went on after the audit, from what it showed.
        "after looking": audited + (1 - audited) * 0.5 * rng.random(DRAWS),
    }[head_start]
    volume = Audit().certify(mixed([0.5], [0.1] * n), confidence).volume
    held = (1 - np.maximum(audited, searched) <= volume).mean()
    allowed = 4.5 * np.sqrt(confidence * (1 - confidence) / DRAWS)
    assert held > confidence - allowed
    assert (abs(held - confidence) < allowed) == (head_start == "none")  # exact, where the search adds nothing


@given(st.integers(1, 300), betas)
def test_more_audited_draws_never_widen_and_more_confidence_never_tightens(n: int, beta: float) -> None:
    certificates = [
        Audit().certify(mixed([0.5], [0.1] * m), 1 - b) for m, b in ((n, beta), (n + 1, beta), (n, beta / 2))
    ]
    assert certificates[1].volume <= certificates[0].volume <= certificates[2].volume


def test_an_audit_without_draws_or_with_a_failed_one_is_refused() -> None:
    with refuses(CertificateError, "--audit"):
        Audit().certify(mixed([0.5, 0.2], []))
    with refuses(CertificateError, 1, 2):
        Audit().certify(mixed([0.5], [0.2, np.nan]))


def test_a_search_that_failed_does_not_spoil_an_audit() -> None:
    assert Audit().certify(mixed([0.5, np.nan], [0.2, 0.3])).upper_bound == 0.5


def test_to_discard_as_many_as_failed_would_be_more_often_wrong_than_stated() -> None:
    # Why an audit with failures is refused and not answered by discarding them: k must be chosen beforehand.
    n, beta, failing, rng = 59, 0.05, 0.0494, np.random.default_rng(8)
    badness = np.sort(rng.random((DRAWS, n)), axis=1)
    failed = (badness > 1 - failing).sum(axis=1)
    volume_left = 1 - badness[np.arange(DRAWS), n - 1 - failed]
    claimed = np.array([volume_bound(n, k, beta) for k in range(n - 1)])[failed]
    assert (volume_left > claimed).mean() > beta + 0.02


# How many draws there were to be, and when that was decided


def planned(counts: list[int | None], origin: str = "iid") -> Sample:
    n = len(counts)
    distances = np.linspace(0.1, 0.5, n)
    return Sample(np.full((n, 1), 0.5), distances, [origin] * n, ["completed"] * n, planned=counts)  # type: ignore[list-item]


@pytest.mark.parametrize("discarded", [0, 2])
def test_draws_that_ended_with_the_verdict_are_refused(discarded: int) -> None:
    with refuses(CertificateError, "--audit"):
        scenario(planned([0] * 30), 0.95, discarded)
    with refuses(CertificateError, "--audit", "N"):
        Audit().certify(planned([0] * 30), 0.95)


@pytest.mark.parametrize("discarded", [0, 2])
def test_a_number_of_draws_that_was_raised_after_looking_is_refused(discarded: int) -> None:
    with refuses(CertificateError, 20, 40):
        scenario(planned([20] * 20 + [40] * 20), 0.95, discarded)
    assert scenario(planned([40] * 40), 0.95, discarded).trials == 40


@pytest.mark.parametrize("counts", [[None] * 10 + [20] * 20, [20] * 20 + [None] * 10])
def test_imported_draws_do_not_stand_beside_counted_ones(counts: list[int | None]) -> None:
    with refuses(CertificateError, 10, "--kind"):
        scenario(planned(counts), 0.95)
    assert scenario(planned([None] * 30), 0.95).trials == 30  # imported alone, they are the user's word


def test_an_audit_that_was_extended_counts_the_draws_that_were_decided_on_last() -> None:
    certificate = Audit().certify(planned([20] * 20 + [60] * 40), 0.95)
    assert certificate.trials == 40
    assert certificate.volume == pytest.approx(volume_bound(40, 0, 0.05))
    assert certificate.upper_bound == 0.5
    assert certificate.details["not_counted"] == 20
    assert_names(certificate.assumptions, 20)
    assert Audit().certify(planned([0] * 10 + [30] * 20), 0.95).trials == 20


def test_the_statement_on_an_extended_audit_holds_as_often_as_stated() -> None:
    # Look at 20 draws; go on with 20 more only where they look bad. All 40 together would be wrong too often where
    # the first alone are not; each batch by itself is right as often as stated, given all that was seen before it.
    rng, beta = np.random.default_rng(3), 0.1
    first, second = rng.random((DRAWS, 20)).max(axis=1), rng.random((DRAWS, 20)).max(axis=1)
    went_on = first < 0.95
    volume = volume_bound(20, 0, beta)
    wrong = (1 - np.maximum(first, second) > volume)[went_on].mean()
    assert wrong <= beta + 0.01


def test_what_is_known_of_the_number_of_draws_is_said() -> None:
    for certified in (Scenario().certify, Audit().certify):
        unknown = " ".join(certified(planned([None] * 20)).assumptions)
        known = " ".join(certified(planned([20] * 20)).assumptions)
        assert len(known) < len(unknown)  # the store does not know when it was chosen
        ended_early = " ".join(certified(planned([30] * 20)).assumptions)
        assert_names(ended_early, 30, "planned", 20)


def test_draws_say_nothing_of_a_model_that_was_learned_from_them() -> None:
    for certified in (Scenario().certify, Audit().certify):
        certified(planned([20] * 20))


def test_failures_are_listed() -> None:
    certificate = scenario(sample([0.1, np.nan, 0.3]), discarded=1)
    assert certificate.details["failures"]["failed"] == [1]
    assert_names(certificate.assumptions, 1, "failed")
    audited = Audit().certify(mixed([0.4, np.nan], [0.1, 0.5]))
    assert audited.details["failures"]["failed"] == [1]
    assert_names(audited.assumptions, 1, "failed")


def test_an_unmeasured_draw_is_a_violation_that_can_be_measured() -> None:
    trials = Sample(
        np.zeros((3, 1)), np.array([0.1, np.nan, 0.2]), ["iid"] * 3, ["completed", "unmeasured", "completed"]
    )
    for certified in (Scenario().certify, Audit().certify):
        with refuses(CertificateError, 1, "STORE"):
            certified(trials)


def test_an_audit_that_was_stopped_says_how_many_draws_were_planned() -> None:
    validation = make_validation()
    campaign = Campaign(validation, search=searches.GPUCB(), seed=1).run(5)
    ended: list[int] = []

    def stop(trial: Trial) -> None:
        ended.append(trial.number)
        if len(ended) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        campaign.audit(20, stop)
    said = Audit().certify(Sample.of(campaign.trials)).assumptions[0]
    assert_names(said, 20, 4)
    assert Audit().certify(Sample.of(campaign.audit(20).trials)).assumptions[0]
