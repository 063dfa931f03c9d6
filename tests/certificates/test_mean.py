"""The certificate of the expected distance: what it says, what it refuses, and that it never validates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from conftest import Predicted, make_validation
from ctxval import Campaign, searches
from ctxval.certificates import CertificateOptions, Mean, Sample, certify_mean, judge_by
from ctxval.errors import CertificateError

SQUARE = Predicted(lambda points: points[:, 0] ** 2)


def sample(n: int = 60, learned: Predicted | None = SQUARE, failing: int = 0) -> Sample:
    points = np.random.default_rng(4).random((n, 1))
    distances = points[:, 0] ** 2 + 0.1
    distances[:failing] = np.nan
    states = ["failed"] * failing + ["completed"] * (n - failing)
    return Sample(points, distances, ["iid"] * n, states, planned=[n] * n, learned=learned)  # type: ignore[arg-type]


def test_a_good_prediction_narrows_the_interval_around_the_true_mean() -> None:
    powered = certify_mean(sample()).details
    plain = certify_mean(sample(learned=Predicted(lambda points: np.full(len(points), np.nan)))).details
    exact = 1 / 3 + 0.1
    for found in (powered, plain):
        assert found["lower_limit"] <= exact <= found["upper_limit"]
    assert powered["upper_limit"] - powered["lower_limit"] < 0.3 * (plain["upper_limit"] - plain["lower_limit"])
    assert (plain["weight"], plain["variance_left"], plain["unpredicted_draws"]) == (0, 1, 60)
    assert powered["variance_left"] < 0.01


def test_it_says_whether_it_is_asymptotic() -> None:
    asymptotic, finite = certify_mean(sample()), certify_mean(sample(), options=Mean(largest_possible=1.5))
    assert asymptotic.statement.startswith(
        "With 95 % confidence, as far as a normal approximation for 60 draws holds, the"
    )
    assert "the interval is asymptotic and no bound in finite samples" in " ".join(asymptotic.assumptions)
    assert finite.statement.startswith(
        "With confidence 0.95, the expected distance of a task uniform over the task space"
    )
    assert "valid for any number of draws" in " ".join(finite.assumptions)
    assert (asymptotic.details["interval"], finite.details["interval"]) == ("asymptotic", "valid in finite samples")
    assert finite.details["lower_limit"] < asymptotic.details["lower_limit"]
    assert finite.details["upper_limit"] > asymptotic.details["upper_limit"]
    assert certify_mean(sample(5), options=Mean(largest_possible=1.5)).trials == 5


def test_it_never_validates_a_threshold() -> None:
    for threshold in (0.6, 1e9):
        verdict = judge_by(certify_mean(sample()), [], threshold, volume=0.5)
        assert verdict.answer == "undecided"
        assert "says nothing of the largest one, so it validates no threshold" in verdict.reason
    found = certify_mean(sample())
    assert found.upper_bound == math.inf
    assert not found.covers(math.inf, 0.5)
    assert "volume" not in Mean.options()


def test_a_quantile_is_exact_and_shares_the_probability_of_an_error() -> None:
    both, alone = certify_mean(sample(), options=Mean(quantile=0.8)), certify_mean(sample())
    assert both.details["lower_limit"] < alone.details["lower_limit"]
    assert both.details["quantile_low"] <= 0.8**2 + 0.1 <= both.details["quantile_high"]
    assert "and its 0.8 quantile is at least" in both.statement
    far = certify_mean(sample(20), options=Mean(quantile=0.99))
    assert far.details["quantile_high"] is None
    assert "has no upper limit from so few draws" in far.statement


def test_a_failure_counts_as_the_largest_possible_distance_or_is_refused() -> None:
    with pytest.raises(CertificateError, match="the expected distance is not known; state largest_possible"):
        certify_mean(sample(failing=2))
    failing, whole = (certify_mean(sample(failing=k), options=Mean(largest_possible=2.0)) for k in (2, 0))
    assert failing.details["estimate"] > whole.details["estimate"]
    assert failing.details["mean_drawn"] == pytest.approx((np.nansum(sample(failing=2).distances) + 4) / 60)
    assert "with failures as 2," in failing.statement
    # A quantile counts them above everything.
    high = certify_mean(sample(failing=30), options=Mean(largest_possible=2.0, quantile=0.9)).details
    assert high["quantile_high"] is None


def test_what_cannot_be_certified_says_why() -> None:
    negative = sample()
    negative.distances[3] = -0.1
    for given, options, message in (
        (sample(learned=None), Mean(), "the mean certificate uses what the experiment's model predicts"),
        (sample(9), Mean(), "at least 10 independent draws, got 9"),
        (sample(), Mean(largest_possible=0.3), "largest_possible must not be below any distance, got 0.3"),
        (negative, Mean(), "distances that are not negative"),
    ):
        with pytest.raises(CertificateError, match=message):
            certify_mean(given, options=options)


@pytest.mark.slow
def test_on_a_campaign_the_prediction_leaves_little_of_the_variance() -> None:
    campaign = Campaign(make_validation(), search=searches.Auto(), seed=5).run(6, explore=True).audit(40)
    verdict = campaign.verdict(1e3, certificate=CertificateOptions(Mean()))
    assert verdict.answer == "undecided"
    assert verdict.certificate is not None
    details = verdict.certificate.details
    grid = campaign.validation.space.from_unit((np.arange(400)[:, None] + 0.5) / 400)
    truth = campaign.validation.distances(grid).mean()
    assert details["lower_limit"] <= truth <= details["upper_limit"]
    assert details["variance_left"] < 0.05
