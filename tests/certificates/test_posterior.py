from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates import (
    KINDS,
    Certificate,
    MadeGood,
    Maxima,
    Options,
    Sample,
    TheoremConstants,
    certify,
    certify_posterior,
    draw_maxima,
    settle_maxima,
)
from ctxval.certificates.base import at_most
from ctxval.certificates.posterior import _MOST
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError, UnknownNameError
from ctxval.gp.hyperposterior import Prior

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
    with pytest.raises(CertificateError, match="needs more than the 19 draws"):
        maxima.upper(0.951)
    assert maxima.probability(19) == 0.95


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.1, 1.5, np.nan])
def test_a_confidence_that_is_no_probability_is_refused(confidence: float) -> None:
    with pytest.raises(CertificateError, match="strictly between 0 and 1"):
        drawn([1.0, 2.0]).upper(confidence)
    with pytest.raises(CertificateError, match="strictly between 0 and 1"):
        certify_posterior(sample(), confidence)


# The draws


@pytest.mark.parametrize("d", [1, 3])
def test_no_bound_is_below_the_largest_distance_that_was_executed(d: int) -> None:
    trials = sample(d=d)
    maxima = quick(trials)
    assert maxima.draws[0] >= trials.best
    assert (np.diff(maxima.draws) >= 0).all()
    assert ((maxima.points >= 0) & (maxima.points <= 1)).all()
    assert certify_posterior(trials, 0.01, found=maxima).upper_bound >= trials.best


def test_units_do_not_matter() -> None:
    plain, scaled = quick(sample()), quick(sample(factor=4.0))
    np.testing.assert_allclose(scaled.draws, 4 * plain.draws, rtol=1e-6)
    own = Prior(offset=None)  # the logarithm's zero is that of the distance
    trials = sample()
    moved = Sample(trials.points, trials.distances + 50, trials.origins, trials.states)
    first, second = (draw_maxima(some, draws=10, paths=4, prior=own) for some in (trials, moved))
    np.testing.assert_allclose(second.draws - 50, first.draws, atol=1e-3)


def test_the_seed_decides_and_the_order_of_origins_does_not() -> None:
    np.testing.assert_array_equal(quick(sample()).draws, quick(sample(origin="iid")).draws)
    assert (quick(sample(), seed=1).draws != quick(sample(), seed=2).draws).any()


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


def test_on_the_prior_the_stated_confidence_is_the_measured_coverage() -> None:
    runs, held = 60, {0.5: 0, 0.9: 0}
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
    certificate = certify_posterior(noisy, 0.9, stochastic=True, found=maxima)
    assert 3.5 < certificate.upper_bound < noisy.best
    assert "expected distance" in certificate.statement
    assert any("noise" in line for line in certificate.assumptions)
    assert not any(np.isfinite(one.warp.offset) for one in maxima.conditioned)  # else it would bound the median
    assert quick(noisy).upper(0.9) > noisy.best  # taken for exact, the noise is roughness


# What is refused


@pytest.mark.parametrize(
    ("distances", "sentence"),
    [
        ([0.1, 0.2, np.nan, 0.3, 0.4], "1 of 5 executions failed"),
        ([0.1, 0.2, 0.3], "at least 4 trials, got 3"),
        ([0.2] * 6, "all 6 distances are 0.2"),
    ],
)
def test_trials_that_bound_nothing_are_refused(distances: list[float], sentence: str) -> None:
    n = len(distances)
    states = ["failed" if np.isnan(distance) else "completed" for distance in distances]
    trials = Sample(np.linspace(0, 1, n)[:, None], np.array(distances), ["iid"] * n, states)  # type: ignore[arg-type]
    with pytest.raises(CertificateError, match=sentence):
        draw_maxima(trials)


def test_open_trials_are_refused() -> None:
    with pytest.raises(CertificateError, match="are open"):
        Sample(np.zeros((2, 1)), np.array([1.0, np.nan]), ["iid"] * 2, ["completed", "open"])
    with pytest.raises(CertificateError, match="nothing was executed"):
        Sample.of([])


# The certificate


def test_a_certificate_says_everything_and_is_ready_for_json() -> None:
    trials = sample()
    certificate = certify_posterior(trials, 0.9, found=quick(trials))
    back = json.loads(json.dumps(certificate.to_json(), allow_nan=False))
    assert (back["kind"], back["confidence"], back["volume"], back["trials"]) == ("posterior", 0.9, 0.0, 9)
    assert back["details"]["best"] == trials.best
    assert back["details"]["gap"] == pytest.approx(certificate.upper_bound - trials.best)
    assert back["details"]["instantaneous"]["max_ucb"] >= trials.best - 1e-3
    assert sum(back["details"]["kernels"].values()) == pytest.approx(1)
    assert len(back["details"]["length_scales"]) == 1
    assert back["version"]
    assert "Gaussian process" in " ".join(back["assumptions"])


def everything(kind: str) -> tuple[Sample, Options]:
    trials = sample(30, origin="acquisition" if kind == "convergence" else "iid")
    theorem = TheoremConstants(1.0, 0.01, 1.0, 3.0, 1.0)
    return trials, Options(discard=2, theorem=theorem)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "posterior"])
@given(confidences, confidences)
def test_more_confidence_never_gives_a_lower_bound_or_a_smaller_volume(kind: str, one: float, other: float) -> None:
    trials, options = everything(kind)
    low, high = (certify(trials, kind, confidence, options) for confidence in sorted([one, other]))
    assert low.upper_bound <= high.upper_bound
    assert low.volume <= high.volume


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_its_name_on_its_certificate(kind: str) -> None:
    trials, options = everything(kind)
    certificate = certify(trials, kind, 0.9, options)
    assert isinstance(certificate, Certificate)
    assert certificate.kind == kind
    assert certificate.upper_bound >= np.sort(trials.distances)[-3]
    assert certificate.assumptions


def test_what_a_kind_needs_and_is_not_given_is_asked_for() -> None:
    trials, _ = everything("scenario")
    with pytest.raises(CertificateError, match="how many to discard"):
        certify(trials, "sampling-discarding", 0.9)
    with pytest.raises(CertificateError, match="needs its constant C"):
        certify(trials, "convergence", 0.9)
    with pytest.raises(UnknownNameError, match="did you mean 'posterior'"):
        certify(trials, "posteriour", 0.9)


def of(X: np.ndarray, y: np.ndarray) -> Sample:
    return Sample(X, np.asarray(y, float), ["acquisition"] * len(y), ["completed"] * len(y))


@pytest.mark.parametrize("factor", [1e-200, 1e155, 1e300])
def test_numbers_whose_squares_no_float_holds_are_refused(factor: float) -> None:
    with pytest.raises(CertificateError, match="take other units"):
        draw_maxima(sample(factor=factor))


def test_distances_that_differ_by_rounding_are_refused() -> None:
    with pytest.raises(CertificateError, match="by rounding alone"):
        draw_maxima(of(sample().points, 1 + 2.3e-16 * np.arange(9)))


def test_one_task_with_two_distances_is_not_deterministic() -> None:
    X, y = sample().points.copy(), sample().distances
    X[5] = X[2]
    with pytest.raises(CertificateError, match=r"trials 2 and 5 executed one task.*say --stochastic"):
        draw_maxima(of(X, y))
    assert np.isfinite(quick(of(X, y), stochastic=True).draws).all()
    same = y.copy()
    same[5] = y[2]
    assert np.isfinite(quick(of(X, same)).draws).all()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.23441, "1.235"),
        (0.00099999, "0.001"),
        (-1.23459, "-1.234"),
        (2, "2"),
        (0, "0"),
        (99.991, "100"),
        (1e-12, "1e-12"),
        (12345.6, "1.235e+04"),
    ],
)
def test_a_printed_bound_is_not_smaller_than_the_bound(value: float, text: str) -> None:
    assert float(at_most(value)) >= value
    assert at_most(value) == text
    assert float(at_most(float("inf"))) == float("inf")


def test_a_confidence_below_1_is_not_printed_as_1() -> None:
    certificate = certify(
        Sample(np.zeros((9, 1)), np.arange(9.0), ["iid"] * 9, ["completed"] * 9), "scenario", 0.9999999
    )
    assert "confidence 0.9999999," in certificate.statement


def test_proposition_1_is_refused_where_another_search_chose_the_tasks() -> None:
    with pytest.raises(CertificateError, match="CMAES chose these"):
        certify(sample(), "convergence", 0.9, Options(constant=1.0, search="CMAES"))


# The error of the bound


def test_the_error_is_what_seeds_differ_by() -> None:
    trials = sample(7)
    found = [draw_maxima(trials, draws=48, paths=4, seed=seed) for seed in range(24)]
    for confidence in (0.8, 0.9):
        bounds = np.array([maxima.upper(confidence) for maxima in found])
        errors = np.array([maxima.error(confidence) for maxima in found])
        assert 0.5 * bounds.std(ddof=1) < np.median(errors) < 2 * bounds.std(ddof=1)
        assert (np.abs(bounds - bounds.mean()) < 2 * errors).mean() >= 0.8


def test_more_draws_have_a_smaller_error() -> None:
    few, many = (draw_maxima(sample(7), draws=draws, paths=4) for draws in (16, 256))
    assert 0 < many.error(0.9) < 0.7 * few.error(0.9)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    seeds: list[int] = []

    def few(trials: Sample, *, seed: int = 0, stochastic: bool = False) -> Maxima:
        seeds.append(seed)
        return draw_maxima(trials, draws=10, paths=4, seed=seed, stochastic=stochastic)

    monkeypatch.setattr("ctxval.certificates.posterior.draw_maxima", few)
    return seeds


def test_far_from_the_threshold_the_draws_are_those_of_one_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds, usual = counted(monkeypatch), quick(sample())
    for threshold in (1e-3, 1e3):
        np.testing.assert_array_equal(settle_maxima(sample(), threshold, 0.9).draws, usual.draws)
    assert seeds == [0, 0]


def test_near_the_threshold_more_is_drawn_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds, trials = counted(monkeypatch), sample(6)
    usual = quick(trials)
    found = settle_maxima(trials, usual.upper(0.9), 0.9)
    assert 2 <= len(seeds) <= _MOST
    assert len(set(seeds)) == len(seeds)
    assert len(found.draws) == len(seeds) * len(usual.draws)
    assert len(found.conditioned) == 10 * len(seeds)
    assert (np.diff(found.draws) >= 0).all()
    assert np.bincount(found.owners).tolist() == [4] * len(found.conditioned)
    assert np.isin(usual.draws, found.draws).all()


def test_a_certificate_says_its_error() -> None:
    trials = sample(6)
    maxima = quick(trials)
    certificate = certify_posterior(trials, 0.8, found=maxima, resolution=1)
    assert certificate.error == certificate.details["error"] == maxima.error(0.8) > 0
    assert "±" in certificate.statement
    assert "standard error of the random draws" in certificate.statement
    assert not certificate.covers(certificate.upper_bound)
    assert certificate.covers(certificate.upper_bound + 2.001 * certificate.error)


# What failed and what was made good


def made_good(because: str | None) -> Sample:
    trials = sample()
    parts = (trials.points, trials.distances, trials.origins, trials.states, trials.numbers)
    return Sample(*parts, made_good=(MadeGood(2, 7, because),))


@pytest.mark.parametrize("stochastic", [False, True])
def test_a_failure_made_good_for_no_stated_reason_withdraws_the_bound(stochastic: bool) -> None:
    found = quick(sample(), stochastic=stochastic)
    certificate = certify_posterior(made_good(None), 0.9, found=found, stochastic=stochastic, resolution=1)
    assert not certificate.covers(1e9)
    assert certificate.doubt is not None
    assert "trial 2 failed and trial 7 executed the same task with success, for no stated reason" in certificate.doubt
    assert '--again 2 --because "what was changed"' in certificate.doubt
    explained = certify_posterior(made_good("fuse replaced"), 0.9, found=found, stochastic=stochastic, resolution=1)
    assert explained.covers(1e9)
    assert any("fuse replaced" in sentence for sentence in explained.assumptions)
    assert explained.details["failures"]["made_good"] == [{"trial": 2, "by": 7, "because": "fuse replaced"}]


def test_an_unmeasured_trial_bars_the_bound_and_can_be_measured() -> None:
    trials = sample()
    distances, states = trials.distances.copy(), ["completed"] * 9
    distances[3], states[3] = np.nan, "unmeasured"
    with pytest.raises(CertificateError, match=r"Trial 3 was executed.*`ctxval remeasure STORE`"):
        draw_maxima(Sample(trials.points, distances, trials.origins, states))  # type: ignore[arg-type]


# The order of imported rows


def imported(order: np.ndarray, spike: float) -> list[Trial]:
    X = np.append(np.linspace(0, 1, 14), 0.46)
    y = 2 + np.sin(3 * X)
    y[-1] += spike
    return [
        Trial(k, "manual", "completed", np.array([X[row]]), {}, 0, True, float(y[row])) for k, row in enumerate(order)
    ]


@pytest.mark.parametrize("spike", [0.0, 8.0])
def test_the_order_of_imported_rows_changes_nothing(spike: float) -> None:
    rng, found = np.random.default_rng(1), []
    worst_first = np.roll(np.arange(15), 1)
    for order in (np.arange(15), worst_first, rng.permutation(15), rng.permutation(15)):
        trials = Sample.of(imported(order, spike))
        for stochastic in (False, True):
            maxima = quick(trials, stochastic=stochastic)
            made = certify_posterior(trials, 0.8, found=maxima, stochastic=stochastic)
            found.append((stochastic, made.upper_bound, made.error, made.doubt is None))
    assert len(set(found)) == 2
    assert {one[0]: one[3] for one in found}[False] == (spike == 0)


def test_the_test_of_unordered_trials_sees_as_much_as_that_of_trials_in_order() -> None:
    heights = (0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
    fired = {"in order": 0, "worst first": 0, "unordered": 0}
    X = np.append(np.linspace(0, 1, 24), 0.5)
    for height in heights:
        y = np.sin(3 * X)
        y[-1] += height
        worst_first = np.roll(np.arange(25), 1)
        for name, rows, origin in (
            ("in order", np.arange(25), "acquisition"),
            ("worst first", worst_first, "acquisition"),
            ("unordered", worst_first, "manual"),
        ):
            trials = Sample(X[rows][:, None], y[rows], [origin] * 25, ["completed"] * 25)  # type: ignore[list-item]
            fired[name] += (
                certify_posterior(trials, 0.8, found=draw_maxima(trials, draws=24, paths=1)).doubt is not None
            )
    assert fired["worst first"] == 0
    assert fired["unordered"] >= max(4, fired["in order"])
