"""The region bound against simulated campaigns, closed forms and the scenario bound."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import learned_by, make_validation
from ctxval import Campaign, searches
from ctxval.certificates import (
    Audit,
    Certificate,
    CertificateOptions,
    Learned,
    Region,
    Sample,
    judge_by,
    volume_bound,
)
from ctxval.errors import CertificateError
from facts import assert_names, refuses
from rig_thorough import more

CAMPAIGNS = 20_000
Function = Callable[[np.ndarray], np.ndarray]


def flat(points: np.ndarray) -> np.ndarray:
    return np.full(len(points), 0.5)


def slope(points: np.ndarray) -> np.ndarray:
    return np.asarray(points[:, 0])


def region(
    sample: Sample, threshold: float | None = None, confidence: float = 0.95, options: Region | None = None
) -> Certificate:
    return (options or Region()).certify(replace(sample, threshold=threshold), confidence)


def draws(
    distances: list[float],
    function: Function | None = flat,
    planned: list[int | None] | None = None,
    predictions: int = 1000,
) -> Sample:
    n = len(distances)
    states = ["failed" if math.isnan(distance) else "completed" for distance in distances]
    points = np.random.default_rng(0).random((n, 1))
    sample = Sample(points, np.array(distances), ["iid"] * n, states, planned=planned or [n] * n)  # type: ignore[arg-type]
    counted = sample.countable
    if function is None:
        return sample
    if not counted:
        return replace(sample, learned=Learned())
    learned = learned_by(function, points[counted], counted[0], predictions)
    return replace(sample, learned=learned)


# The statement


@pytest.mark.slow
@pytest.mark.parametrize(("beta", "discarded"), [(0.05, 2), *more((0.05, 0), (0.2, 0), (0.2, 2))])
def test_the_margin_holds_as_often_as_stated(beta: float, discarded: int) -> None:
    """Many campaigns of 40 draws, whose prediction is learned from 5 trials before them and differs in each."""
    rng, n = np.random.default_rng(3), 40

    def distance(p: np.ndarray) -> np.ndarray:
        return np.sin(5 * p) + 2 * (p > 0.9)

    trained = np.sort(rng.random((CAMPAIGNS, 5)), axis=1)
    slopes = (distance(trained) * trained).mean(axis=1) / (trained**2).mean(axis=1)
    p = rng.random((CAMPAIGNS, n))
    margins = np.sort(distance(p) - slopes[:, None] * p, axis=1)[:, n - 1 - discarded]
    grid = (np.arange(2000) + 0.5) / 2000
    volume = volume_bound(n, discarded, beta)
    violated = np.zeros(CAMPAIGNS)
    for start in range(0, CAMPAIGNS, 2000):
        rows = slice(start, start + 2000)
        excess = distance(grid) - slopes[rows, None] * grid
        violated[rows] = (excess > margins[rows, None]).mean(axis=1)
    missed = (violated > volume + 1e-3).mean()  # the grid resolves no less
    allowed = 4 * np.sqrt(beta * (1 - beta) / CAMPAIGNS)
    assert missed <= beta + allowed
    assert missed > 0.6 * beta  # and the bound is not empty


@pytest.mark.parametrize("beta", [0.05, *more(0.2)])
def test_the_volume_above_a_threshold_is_exceeded_as_rarely_as_stated(beta: float) -> None:
    """Draws and map together: many campaigns, in which the true volume above the threshold is known.

    The distance is uniform, with a prediction that is off by an independent uniform error.
    """
    rng, n, predictions, threshold = np.random.default_rng(4), 30, 200, 0.9
    error = 0.4
    distances = rng.random((CAMPAIGNS, n))
    margins = (distances - (distances - error * rng.random((CAMPAIGNS, n)))).max(axis=1)
    outside = rng.binomial(predictions, np.clip(_share_above(threshold - margins, error), 0, 1))
    volumes = np.array(
        [volume_bound(predictions, k, 0.05 * beta) if k < predictions else 1.0 for k in range(predictions + 1)]
    )
    total = np.minimum(1, volume_bound(n, 0, 0.95 * beta) + volumes[outside])
    missed = (1 - threshold > total).mean()
    assert missed <= beta + 4 * np.sqrt(beta * (1 - beta) / CAMPAIGNS)


def _share_above(limit: np.ndarray, error: float) -> np.ndarray:
    """Return Pr(U - error V > limit) of independent uniform U and V, from the area of the unit square."""
    v = (np.arange(400) + 0.5) / 400
    return np.clip(1 - limit[:, None] - error * v, 0, 1).mean(axis=1)


def test_with_a_prediction_of_nothing_it_is_the_scenario_bound() -> None:
    distances = np.random.default_rng(1).random(60).tolist()
    found = region(draws(distances, lambda points: np.zeros(len(points))))
    assert found.details["margin"] == max(distances)
    assert found.details["volume_of_draws"] == pytest.approx(volume_bound(60, 0, 0.95 * 0.05))
    assert found.upper_bound == max(distances)
    assert found.volume > Audit().certify(draws(distances)).volume


@given(st.lists(st.floats(0.0, 5.0), min_size=5, max_size=40), st.floats(0.01, 0.5), st.floats(-3.0, 3.0))
def test_a_constant_error_of_the_prediction_is_made_good_by_the_margin(
    distances: list[float], beta: float, shift: float
) -> None:
    found = region(draws(distances), confidence=1 - beta)
    moved = region(draws(distances, lambda points: np.full(len(points), 0.5 + shift)), confidence=1 - beta)
    assert moved.upper_bound == pytest.approx(found.upper_bound, abs=1e-9)
    assert moved.volume == found.volume


@given(st.lists(st.floats(0.0, 5.0), min_size=6, max_size=40), st.integers(0, 3), st.floats(0.1, 5.0))
def test_discarding_lowers_the_margin_and_widens_the_volume(distances: list[float], k: int, threshold: float) -> None:
    one, other = (region(draws(distances, slope), threshold, options=Region(discard=j)) for j in (k, k + 1))
    assert other.details["margin"] <= one.details["margin"]
    assert other.details["volume_of_draws"] >= one.details["volume_of_draws"]
    assert other.details["share_kept"] >= one.details["share_kept"]


@given(st.lists(st.floats(0.0, 1.0), min_size=6, max_size=40), st.floats(0.1, 3.0))
def test_a_higher_threshold_is_kept_on_a_larger_map(distances: list[float], threshold: float) -> None:
    low, high = (region(draws(distances, slope), tau) for tau in (threshold, 1.1 * threshold))
    assert high.details["share_kept"] >= low.details["share_kept"]
    assert high.volume <= low.volume


def test_the_share_of_the_map_is_estimated_with_its_error() -> None:
    sample = draws([0.0, *np.random.default_rng(2).random(59)], lambda points: 2 * points[:, 0], predictions=4000)
    margin = region(sample).details["margin"]
    found = region(sample, 1.2, options=Region(predictions=4000))
    exact = np.clip((1.2 - margin) / 2, 0, 1)
    assert abs(found.details["share_kept"] - exact) < 4 * found.details["share_error"]
    assert found.details["share_error"] == pytest.approx(np.sqrt(exact * (1 - exact) / 4000), rel=0.1)
    assert found.volume >= 1 - exact


# What counts, and what is refused


def test_failures_and_tasks_without_a_prediction_count_as_violations() -> None:
    failed = draws([0.1, math.nan, *[0.2] * 28])
    with refuses(CertificateError, 1, 30, 0):
        region(failed)
    assert region(failed, options=Region(discard=1)).details["margin"] == pytest.approx(-0.3)

    def partly(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 0] < 0.9, 0.5, np.nan)

    sample = draws([0.2] * 30, partly)
    missing = int((sample.points[:, 0] >= 0.9).sum())
    assert missing > 0
    with refuses(CertificateError, 0, 30, missing):
        region(sample)
    found = region(sample, 1.0, options=Region(discard=missing))
    assert found.details["unpredicted_draws"] == missing
    assert found.details["unpredicted_tasks"] == found.details["predictions"] - 1000 * found.details["share_kept"]


def test_what_cannot_be_certified_says_why() -> None:
    def nothing(points: np.ndarray) -> np.ndarray:
        return np.full(len(points), np.nan)

    for sample, options, facts in (
        (draws([0.1] * 5, None), Region(), ("Campaign.verdict",)),
        (draws([0.1] * 5, nothing), Region(), (0, "--kind")),
        (draws([0.1] * 5), Region(discard=5), (5, 0, 4)),
        (draws([0.1] * 5, planned=[0] * 5), Region(), ("--audit", 5)),
    ):
        with refuses(CertificateError, *facts):
            region(sample, options=options)
    with refuses(CertificateError, "bound", "--audit"):
        region(Sample(np.zeros((2, 1)), np.ones(2), ["manual"] * 2, ["completed"] * 2, learned=Learned()))


def test_only_the_draws_of_the_last_decision_count_and_the_prediction_is_older() -> None:
    found = region(draws([0.1] * 50, planned=[20] * 20 + [50] * 30))
    assert found.trials == 30
    assert found.details["learned_before"] == 20
    assert found.details["not_counted"] == 20
    assert_names(" ".join(found.assumptions), 20, "draws")


def test_it_validates_only_if_the_whole_volume_is_accepted() -> None:
    sample = draws([0.1] * 70, slope)
    found = region(sample, 2.0)
    assert found.upper_bound == 2.0
    assert 0.04 < found.details["volume_of_draws"] < found.volume < 0.05
    assert not found.covers(2.0)
    assert found.covers(2.0, 0.05)
    partly = region(sample, 0.8)
    assert partly.volume > 1 - 0.8
    verdict = judge_by(partly, [], 0.8, volume=0.05)
    assert verdict.answer == "undecided"
    assert_names(verdict.reason, "draws")


def test_a_margin_below_zero_is_said_in_words() -> None:
    text = region(draws([0.1] * 30)).statement
    assert_names(text, 0.4)
    over = region(draws([0.7] * 30), 0.65).statement
    assert_names(over, 0.2)
    assert_names(over, 0.65, 0, 0.1)


@pytest.mark.thorough
def test_on_campaigns_the_bound_holds_at_tasks_that_were_not_drawn() -> None:
    exceeding = [seed for seed in (4, 5, 6, 7) if share_above_bound(seed) > 0]
    assert len(exceeding) <= 1  # each holds with a probability of 0.95; of seeds 0 to 15, that of seed 5 does not


def share_above_bound(seed: int) -> float:
    """Return by how much the volume above the bound of a campaign exceeds the volume that the bound leaves out."""
    campaign = Campaign(make_validation(), search=searches.Auto(), seed=seed).run(6, explore=True).audit(60)
    threshold = 1.01 * max(trial.distance or 0.0 for trial in campaign.trials)
    by = CertificateOptions(Region(), volume=0.1)
    verdict = campaign.verdict(threshold, certificate=by)
    assert verdict.answer == "validated"
    certificate = verdict.certificate
    assert certificate is not None
    assert certificate.details["learned_before"] == 6
    points = np.linspace(0, 1, 201)[:, None]
    truth = campaign.validation.distances(campaign.validation.space.from_unit(points))
    bound = campaign.recorder.dynamics.expected(campaign.trials, points, 6) + certificate.details["margin"]
    assert certificate.details["margin"] < 0.1 * truth.max()
    return float((truth > bound).mean() - certificate.details["volume_of_draws"])
