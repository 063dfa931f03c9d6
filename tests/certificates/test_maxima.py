from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates import (
    DistanceBound,
    Maxima,
    Sample,
    draw_maxima,
    settle_maxima,
)
from ctxval.certificates.maxima import MAXIMA, representative
from ctxval.errors import CertificateError, InputError
from ctxval.gp.hyperposterior import Prior
from facts import assert_names, refuses
from rig_thorough import more

confidences = st.floats(0.01, 0.999)
numbers = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60)


def drawn(values: list[float]) -> Maxima:
    return Maxima(np.sort(values), np.zeros((len(values), 1)), [], np.zeros(len(values), dtype=np.intp))


def sample(n: int = 9, d: int = 1, origin: str = "acquisition", factor: float = 1.0) -> Sample:
    rng = np.random.default_rng([n, d])
    X = rng.random((n, d))
    y = factor * (1.5 + np.sin(6 * X).sum(axis=1))
    return Sample(X, y, [origin] * n, ["completed"] * n)  # type: ignore[list-item]


def quick(trials: Sample, seed: int = 0, stochastic: bool = False) -> Maxima:
    return draw_maxima(trials, draws=10, paths=4, seed=seed, stochastic=stochastic)


@pytest.fixture(scope="module")
def usual() -> Maxima:
    """The draws of a sample with the first seed."""
    return quick(sample())


# The order statistic


@given(numbers, confidences, confidences)
def test_more_confidence_never_lowers_the_bound(values: list[float], one: float, other: float) -> None:
    low, high = sorted([one, other])
    maxima = drawn(values)
    try:
        assert maxima.upper(low) <= maxima.upper(high)
    except CertificateError:
        assert len(values) < high * (len(values) + 1)


@given(numbers, confidences, st.floats(-1e3, 1e3))
def test_the_bound_is_at_most_a_threshold_just_where_that_is_probable_enough(
    values: list[float], confidence: float, threshold: float
) -> None:
    maxima = drawn(values)
    if confidence * (len(values) + 1) <= len(values):
        covered = maxima.probability(threshold) >= confidence - 1e-9
        assert (maxima.upper(confidence) <= threshold) == covered


def test_the_rank_is_that_of_exchangeable_draws() -> None:
    # Of 19 draws and the truth, each is equally likely to be the largest: 95 % need the largest of the 19.
    maxima = drawn(list(range(1, 20)))
    assert [maxima.upper(c) for c in (0.95, 0.9, 0.5, 1e-12)] == [19, 18, 10, 1]
    with refuses(CertificateError, 19, 0.951):
        maxima.upper(0.951)
    assert maxima.probability(19) == 0.95


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.1, 1.5, np.nan])
def test_a_confidence_that_is_no_probability_is_refused(confidence: float) -> None:
    with refuses(InputError, 0, 1):
        DistanceBound().certify(sample(), confidence)


# The draws


@pytest.mark.slow
@pytest.mark.parametrize("d", [1, *more(3)])
def test_no_bound_is_below_the_largest_distance_that_was_executed(d: int) -> None:
    trials = sample(d=d)
    maxima = quick(trials)
    assert maxima.draws[0] >= trials.best
    assert (np.diff(maxima.draws) >= 0).all()
    assert ((maxima.points >= 0) & (maxima.points <= 1)).all()
    assert DistanceBound().certify_drawn(trials, maxima, 0.01).upper_bound >= trials.best


@pytest.mark.thorough
def test_units_do_not_matter(usual: Maxima) -> None:
    np.testing.assert_allclose(quick(sample(factor=4.0)).draws, 4 * usual.draws, rtol=1e-6)
    own = Prior(offset=None)  # the logarithm's zero is that of the distance
    trials = sample()
    moved = Sample(trials.points, trials.distances + 50, trials.origins, trials.states)
    first, second = (draw_maxima(some, draws=10, paths=4, prior=own) for some in (trials, moved))
    np.testing.assert_allclose(second.draws - 50, first.draws, atol=1e-3)


def test_the_seed_decides_and_the_order_of_origins_does_not(usual: Maxima) -> None:
    np.testing.assert_array_equal(usual.draws, quick(sample(origin="iid")).draws)
    assert (quick(sample(), seed=1).draws != usual.draws).any()


def test_a_function_that_is_known_densely_leaves_no_gap() -> None:
    X = np.linspace(0, 1, 25)[:, None]
    trials = Sample(X, np.sin(3 * X[:, 0]), ["iid"] * 25, ["completed"] * 25)
    assert 1.0 - 1e-6 <= quick(trials).upper(0.9) < 1.002


def from_prior(seed: int) -> tuple[Sample, float]:
    """A path drawn from the prior, its hyperparameters too, seven trials of it chosen adaptively, and its maximum."""
    rng = np.random.default_rng([9, seed])
    hyper = Prior(offset=None).draw(1, rng)
    grid = np.linspace(0, 1, 201)[:, None]
    path = np.linalg.cholesky(hyper.kernel(grid, grid) + 1e-9 * np.eye(201)) @ rng.normal(size=201)
    rows = [20, 70, 130, 180]
    while len(rows) < 7:
        gaps = np.abs(grid - grid[rows].T).min(axis=1)
        near = np.abs(grid - grid[rows[int(path[rows].argmax())]])[:, 0]
        rows.append(int(np.argmin(np.where(gaps > 0.03, near, np.inf)) if len(rows) % 2 else np.argmax(gaps)))
    return Sample(grid[rows], path[rows], ["acquisition"] * 7, ["completed"] * 7), float(path.max())


@pytest.mark.slow
@pytest.mark.parametrize("runs", [20, pytest.param(60, marks=pytest.mark.thorough)])
@pytest.mark.thorough
def test_on_the_prior_the_stated_confidence_is_the_measured_coverage(runs: int) -> None:
    held = {0.5: 0, 0.9: 0}
    for seed in range(runs):
        trials, truth = from_prior(seed)
        maxima = draw_maxima(trials, draws=8, paths=4, seed=seed, prior=Prior(offset=None))
        for confidence in held:
            held[confidence] += truth <= maxima.upper(confidence)
    for confidence, count in held.items():
        allowed = 3 * np.sqrt(confidence * (1 - confidence) / runs)
        assert abs(count / runs - confidence) < allowed, f"{count} of {runs} at {confidence}"


# Stochastic systems


def test_noise_widens_what_is_expected_and_may_stay_below_the_largest_value_seen() -> None:
    rng = np.random.default_rng(5)
    X = rng.random((40, 1))
    mean = 3 + 0.5 * np.sin(3 * X[:, 0])
    noisy = Sample(X, mean + 0.5 * rng.normal(size=40), ["iid"] * 40, ["completed"] * 40)
    maxima = quick(noisy, stochastic=True)
    certificate = DistanceBound().certify_drawn(noisy, maxima, 0.9)
    assert 3.5 < certificate.upper_bound < noisy.best
    assert "expected distance" in certificate.statement
    assert any("noise" in line for line in certificate.assumptions)
    assert not any(np.isfinite(one.warp.offset) for one in maxima.conditioned)  # else it would bound the median
    assert quick(noisy).upper(0.9) > noisy.best  # taken for exact, the noise is roughness


# What is refused


@pytest.mark.parametrize(
    ("distances", "facts"),
    [
        ([0.1, 0.2, np.nan, 0.3, 0.4], (1, 5)),
        ([0.1, 0.2, 0.3], (4, 3)),
        ([0.2] * 6, (6, 0.2)),
    ],
)
def test_trials_that_bound_nothing_are_refused(distances: list[float], facts: tuple[object, ...]) -> None:
    n = len(distances)
    states = ["failed" if np.isnan(distance) else "completed" for distance in distances]
    trials = Sample(np.linspace(0, 1, n)[:, None], np.array(distances), ["iid"] * n, states)  # type: ignore[arg-type]
    with refuses(CertificateError, *facts):
        draw_maxima(trials)


def test_open_trials_are_refused() -> None:
    with refuses(CertificateError, "open", 1):
        Sample(np.zeros((2, 1)), np.array([1.0, np.nan]), ["iid"] * 2, ["completed", "open"])
    with refuses(CertificateError):
        Sample.of([])


def of(X: np.ndarray, y: np.ndarray) -> Sample:
    return Sample(X, np.asarray(y, float), ["acquisition"] * len(y), ["completed"] * len(y))


@pytest.mark.parametrize("factor", [1e-200, 1e155, 1e300])
def test_numbers_whose_squares_no_float_holds_are_refused(factor: float) -> None:
    with refuses(CertificateError, "bound", 1e-100):
        draw_maxima(sample(factor=factor))


def test_distances_that_differ_by_rounding_are_refused() -> None:
    with refuses(CertificateError, 1):
        draw_maxima(of(sample().points, 1 + 2.3e-16 * np.arange(9)))


@pytest.mark.thorough
def test_one_task_with_two_distances_is_not_deterministic() -> None:
    X, y = sample().points.copy(), sample().distances
    X[5] = X[2]
    noisy = draw_maxima(of(X, y), draws=10, paths=4)
    assert noisy.stochastic
    assert np.isfinite(noisy.draws).all()
    same = y.copy()
    same[5] = y[2]
    exact = draw_maxima(of(X, same), draws=10, paths=4)
    assert not exact.stochastic
    assert exact.draws.min() >= same.max()


# The error of the bound


@pytest.mark.thorough
def test_the_error_is_what_seeds_differ_by() -> None:
    trials = sample(7)
    found = [draw_maxima(trials, draws=48, paths=4, seed=seed) for seed in range(12)]
    for confidence in (0.8, 0.9):
        bounds = np.array([maxima.upper(confidence) for maxima in found])
        errors = np.array([maxima.error(confidence) for maxima in found])
        assert 0.5 * bounds.std(ddof=1) < np.median(errors) < 2 * bounds.std(ddof=1)
        assert (np.abs(bounds - bounds.mean()) < 2 * errors).mean() >= 0.8


@pytest.mark.thorough
def test_more_draws_have_a_smaller_error() -> None:
    few, many = (draw_maxima(sample(7), draws=draws, paths=4) for draws in (16, 128))
    assert 0 < many.error(0.9) < 0.7 * few.error(0.9)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    seeds: list[int] = []

    def few(trials: Sample, *, seed: int = 0) -> Maxima:
        seeds.append(seed)
        return draw_maxima(trials, draws=10, paths=4, seed=seed)

    monkeypatch.setattr("ctxval.certificates.maxima.draw_maxima", few)
    return seeds


@pytest.mark.thorough
def test_far_from_the_threshold_the_draws_are_those_of_one_seed(usual: Maxima, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = counted(monkeypatch)
    for threshold in (1e-3, 1e3):
        np.testing.assert_array_equal(settle_maxima(sample(), threshold, 0.9).draws, usual.draws)
    assert seeds == [0, 0]


def test_near_the_threshold_more_is_drawn_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds, trials = counted(monkeypatch), sample(6)
    usual = quick(trials)
    found = settle_maxima(trials, usual.upper(0.9), 0.9)
    assert 2 <= len(seeds) <= MAXIMA.chains
    assert len(set(seeds)) == len(seeds)
    assert len(found.draws) == len(seeds) * len(usual.draws)
    assert len(found.conditioned) == 10 * len(seeds)
    assert (np.diff(found.draws) >= 0).all()
    assert np.bincount(found.owners).tolist() == [4] * len(found.conditioned)
    assert np.isin(usual.draws, found.draws).all()


# Many trials


def test_many_trials_are_represented_by_the_largest_and_well_spread_ones() -> None:
    few, many = sample(MAXIMA.most), sample(1000, 2)
    assert len(representative(few)) == MAXIMA.most
    kept = representative(many)
    assert len(kept) == MAXIMA.most
    assert kept.best == many.best
    assert set(np.sort(many.distances)[-MAXIMA.most // 4 :]) <= set(kept.distances)


@pytest.mark.thorough
def test_a_bound_of_many_trials_says_that_it_uses_some_of_them() -> None:
    many = sample(400)
    certificate = DistanceBound().certify_drawn(many, quick(many), 0.9)
    assert certificate.trials == 400
    assert_names(" ".join(certificate.assumptions), 160, 400, "trials")
    assert certificate.upper_bound >= many.best


def test_many_trials_that_do_not_cover_the_tasks_are_refused_before_the_draws() -> None:
    with refuses(CertificateError, 400, "--audit"):
        DistanceBound().certify(sample(400, 5))
