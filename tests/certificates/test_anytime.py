"""The anytime audit against simulated samples, integrals and the bound of a fixed number of draws."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from typer.testing import CliRunner

from conftest import make_validation
from ctxval import Campaign, searches
from ctxval.certificates import AnytimeAudit, Certificate, CertificateOptions, Sample, volume_bound
from ctxval.certificates.anytime import _NO_VIOLATION, anytime_volume, log_e_value
from ctxval.cli import app
from ctxval.errors import CertificateError
from facts import assert_names, refuses
from rig_thorough import more


def anytime(sample: Sample, threshold: float) -> Certificate:
    return AnytimeAudit().certify(replace(sample, threshold=threshold))


def draws(distances: list[float]) -> Sample:
    n = len(distances)
    states = ["failed" if math.isnan(distance) else "completed" for distance in distances]
    points = np.random.default_rng(0).random((n, 2))
    return Sample(points, np.array(distances), ["iid"] * n, states)  # type: ignore[arg-type]


@pytest.mark.parametrize(("n", "violations", "volume"), [(10, 0, 0.2), (40, 1, 0.1), (200, 7, 0.06), (5, 5, 0.5)])
def test_the_e_value_is_its_integral(n: int, violations: int, volume: float) -> None:
    def ratio(q: float) -> float:
        return (q / volume) ** violations * ((1 - q) / (1 - volume)) ** (n - violations)

    uniform = quad(ratio, 0, volume, epsabs=0, epsrel=1e-10)[0] / volume
    expected = _NO_VIOLATION * ratio(0.0) + (1 - _NO_VIOLATION) * uniform
    assert float(log_e_value(n, violations, np.array(volume))) == pytest.approx(np.log(expected), rel=1e-8)


@pytest.mark.parametrize(
    ("share", "beta"), [(0.02, 0.05), (0.1, 0.2), *more((0.1, 0.05), (0.4, 0.05), (0.02, 0.2), (0.4, 0.2))]
)
def test_the_true_volume_is_rejected_at_any_time_as_rarely_as_stated(share: float, beta: float) -> None:
    """1e5 campaigns of 300 draws, each of which stops at the moment that suits it best."""
    campaigns, horizon = 100_000, 300
    counts = np.zeros(campaigns, dtype=int)
    rejected = np.zeros(campaigns, dtype=bool)
    rng = np.random.default_rng(5)
    for n in range(1, horizon + 1):
        counts += rng.random(campaigns) < share
        by_count = np.array([float(log_e_value(n, k, np.array(share))) for k in range(int(counts.max()) + 1)])
        rejected |= by_count[counts] >= -np.log(beta)
    assert rejected.mean() <= beta + 3 * np.sqrt(beta * (1 - beta) / campaigns)
    assert rejected.mean() > 0.05 * beta  # and the bound is not empty


def test_without_a_violation_it_costs_little_more_than_a_number_fixed_beforehand() -> None:
    for n in (20, 60, 300):
        fixed, anytime = volume_bound(n, 0, 0.05), anytime_volume(np.zeros(n, dtype=bool), 0.05)
        assert fixed < anytime < 1.12 * fixed


@given(st.lists(st.booleans(), min_size=1, max_size=60), st.floats(0.01, 0.5))
def test_more_draws_never_take_a_rejection_back_and_violations_never_help(found: list[bool], beta: float) -> None:
    violating = np.array(found)
    volumes = [anytime_volume(violating[: n + 1], beta) for n in range(len(found))]
    assert all(later <= earlier for earlier, later in itertools.pairwise(volumes))
    assert volumes[-1] >= anytime_volume(np.zeros(len(found), dtype=bool), beta)


@given(st.integers(1, 400), st.integers(0, 20), st.floats(0.001, 0.3))
def test_the_volume_is_where_the_e_value_reaches_the_level(n: int, violations: int, beta: float) -> None:
    violating = np.zeros(n, dtype=bool)
    violating[:violations] = True
    volume = anytime_volume(violating, beta)
    if volume < 1:
        assert float(log_e_value(n, int(violating.sum()), np.array(volume))) >= -np.log(beta) - 1e-6
        assert float(log_e_value(n, int(violating.sum()), np.array(0.999 * volume))) < -np.log(beta)


def test_failures_count_as_violations() -> None:
    good, bad = draws([0.1] * 60), draws([0.1] * 59 + [math.nan])
    assert anytime(bad, 0.5).volume >= anytime(good, 0.5).volume
    early = draws([math.nan] + [0.1] * 59)
    assert anytime(early, 0.5).volume > anytime(good, 0.5).volume
    assert anytime(early, 0.5).details["violations"] == anytime(early, 0.5).details["failed"] == 1


def test_only_independent_draws_count() -> None:
    sample = draws([0.1] * 30)
    mixed = Sample(sample.points, sample.distances, ["iid"] * 20 + ["acquisition"] * 10, sample.states)
    assert anytime(mixed, 0.5).trials == 20
    with refuses(CertificateError, "--audit"):
        anytime(Sample(sample.points, sample.distances, ["acquisition"] * 30, sample.states), 0.5)
    with refuses(CertificateError, "--threshold"):
        AnytimeAudit().certify(sample)


def test_an_audit_may_go_on_after_looking() -> None:
    campaign = Campaign(make_validation(), search=searches.Random(), seed=2)
    threshold, volumes = 1e3, []
    for total in (20, 40, 80):
        campaign.audit(total)
        by = CertificateOptions(AnytimeAudit(), volume=0.05)
        verdict = campaign.verdict(threshold, certificate=by)
        assert verdict.certificate is not None
        volumes.append(verdict.certificate.volume)
    assert volumes == sorted(volumes, reverse=True)
    assert volumes[-1] < 0.05
    assert verdict.answer == "validated"
    assert "exceed" in verdict.reason
    assert verdict.rests_on is not None
    assert "drawn independently" in verdict.rests_on


def test_the_command_line_says_it_also_of_a_falsified_model(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.chdir(tmp_path)
    Campaign(make_validation(), search=searches.Random(), store="a.sqlite", seed=2).run(40)
    shown = CliRunner().invoke(app, ["certify", "a.sqlite", "--kind", "anytime", "--threshold", "1.0"])
    assert shown.exit_code == 1, shown.output
    assert "FALSIFIED" in shown.output
    assert_names(" ".join(shown.output.split()), 1)
    refused = CliRunner().invoke(app, ["certify", "a.sqlite", "--kind", "anytime"])
    assert refused.exit_code == 2
    assert "--threshold" in refused.output
