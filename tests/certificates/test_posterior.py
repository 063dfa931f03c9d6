from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest, t

from ctxval import Trial
from ctxval.certificates import DistanceBound, Maxima, RecoveredFailure, Sample, diagnose, draw_maxima
from ctxval.errors import CertificateError
from ctxval.gp.hyperposterior import EXACT, Conditioned, Hyperparameters, condition
from facts import assert_names, refuses


def sample(n: int = 9, d: int = 1, origin: str = "acquisition", factor: float = 1.0) -> Sample:
    rng = np.random.default_rng([n, d])
    X = rng.random((n, d))
    y = factor * (1.5 + np.sin(6 * X).sum(axis=1))
    return Sample(X, y, [origin] * n, ["completed"] * n)  # type: ignore[list-item]


def quick(trials: Sample, seed: int = 0, stochastic: bool = False) -> Maxima:
    return draw_maxima(trials, draws=10, paths=4, seed=seed, stochastic=stochastic)


def test_a_certificate_says_everything_and_is_ready_for_json() -> None:
    trials = sample()
    certificate = DistanceBound().certify_drawn(trials, quick(trials), 0.9)
    back = json.loads(json.dumps(certificate.to_json(), allow_nan=False))
    assert (back["kind"], back["confidence"], back["volume"], back["trials"]) == ("posterior", 0.9, 0.0, 9)
    assert back["details"]["best"] == trials.best
    assert back["details"]["gap"] == pytest.approx(certificate.upper_bound - trials.best)
    assert back["details"]["instantaneous"]["max_ucb"] >= trials.best - 1e-3
    assert sum(back["details"]["kernels"].values()) == pytest.approx(1)
    assert len(back["details"]["length_scales"]) == 1
    assert back["version"]
    assert "Gaussian process" in " ".join(back["assumptions"])


def test_a_certificate_says_its_error() -> None:
    trials = sample(6)
    maxima = quick(trials)
    certificate = DistanceBound(resolution=1.0).certify_drawn(trials, maxima, 0.8)
    assert certificate.error == certificate.details["error"] == maxima.error(0.8) > 0
    assert "±" in certificate.statement
    assert not certificate.covers(certificate.upper_bound)
    assert certificate.covers(certificate.upper_bound + 2.001 * certificate.error)


@pytest.mark.usefixtures("few_draws")
def test_a_bound_that_a_far_task_withdraws_is_not_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    settled = []
    monkeypatch.setattr(
        "ctxval.certificates.posterior.settle_maxima", lambda *given: settled.append(1) or quick(given[0])
    )
    trials = sample()
    bound = quick(trials).upper(0.9)
    near, far = (DistanceBound(resolution).certify(replace(trials, threshold=bound), 0.9) for resolution in (1.0, 1e-3))
    assert (near.doubt, settled) == (None, [1])
    assert far.doubt is not None


# What failed and what was made good


def made_good(because: str | None) -> Sample:
    trials = sample()
    parts = (trials.points, trials.distances, trials.origins, trials.states, trials.numbers)
    return Sample(*parts, made_good=(RecoveredFailure(2, 7, because),))


@pytest.mark.parametrize("stochastic", [False, True])
def test_a_failure_made_good_for_no_stated_reason_withdraws_the_bound(stochastic: bool) -> None:
    found = quick(sample(), stochastic=stochastic)
    certificate = DistanceBound(resolution=1.0).certify_drawn(made_good(None), found, 0.9)
    assert not certificate.covers(1e9)
    assert certificate.doubt is not None
    assert_names(certificate.doubt, "trial", 2, 7)
    assert_names(certificate.doubt, "--again", 2, "--because")
    explained = DistanceBound(resolution=1.0).certify_drawn(made_good("fuse replaced"), found, 0.9)
    assert explained.covers(1e9)
    assert any("fuse replaced" in sentence for sentence in explained.assumptions)
    assert explained.details["failures"]["made_good"] == [{"trial": 2, "by": 7, "because": "fuse replaced"}]


def test_an_unmeasured_trial_bars_the_bound_and_can_be_measured() -> None:
    trials = sample()
    distances, states = trials.distances.copy(), ["completed"] * 9
    distances[3], states[3] = np.nan, "unmeasured"
    with refuses(CertificateError, 3, "STORE"):
        draw_maxima(Sample(trials.points, distances, trials.origins, states))  # type: ignore[arg-type]


# The order of imported rows


def imported(order: np.ndarray, spike: float) -> list[Trial]:
    X = np.append(np.linspace(0, 1, 14), 0.46)
    y = 2 + np.sin(3 * X)
    y[-1] += spike
    return [
        Trial(k, "manual", "completed", np.array([X[row]]), {}, 0, True, float(y[row])) for k, row in enumerate(order)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("spike", [0.0, 8.0])
@pytest.mark.thorough
def test_the_order_of_imported_rows_changes_nothing(spike: float) -> None:
    rng, found = np.random.default_rng(1), []
    worst_first = np.roll(np.arange(15), 1)
    for order in (np.arange(15), worst_first, rng.permutation(15)):
        trials = Sample.of(imported(order, spike))
        for stochastic in (False, True):
            maxima = quick(trials, stochastic=stochastic)
            made = DistanceBound().certify_drawn(trials, maxima, 0.8)
            found.append((stochastic, made.upper_bound, made.error, made.doubt is None))
    assert len(set(found)) == 2
    assert {one[0]: one[3] for one in found}[False] == (spike == 0)


@pytest.mark.thorough
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
                DistanceBound().certify_drawn(trials, draw_maxima(trials, draws=12, paths=1), 0.8).doubt is not None
            )
    assert fired["worst first"] == 0
    assert fired["unordered"] >= max(4, fired["in order"])


# Posterior diagnostics


GRID = np.linspace(0, 1, 121)[:, None]
KNOWN = Hyperparameters(1.5, np.array([np.log(0.3)]), float(np.log(EXACT)))


def root(hyper: Hyperparameters) -> np.ndarray:
    """The root of the covariances on the grid."""
    return np.linalg.cholesky(hyper.kernel(GRID, GRID) + 1e-9 * np.eye(len(GRID)))


def adaptive(covariances: np.ndarray, rng: np.random.Generator, n: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Points and values of a path, each point chosen from the values before it: near the best, or far from all."""
    path = 5 + 3 * covariances @ rng.normal(size=len(GRID))
    rows = [int(rng.integers(len(GRID)))]
    while len(rows) < n:
        free = [row for row in range(len(GRID)) if row not in rows]
        best = rows[int(np.argmax(path[rows]))]
        far = [min(abs(row - known) for known in rows) for row in free]
        near = [abs(row - best) for row in free]
        rows.append(free[int(np.argmin(near)) if len(rows) % 2 else int(np.argmax(far))])
    return GRID[rows], path[rows]


def surprises(hyper: Hyperparameters, assumed: Hyperparameters, seeds: int = 250) -> list[float]:
    covariances = root(hyper)
    drawn = [adaptive(covariances, np.random.default_rng([4, seed])) for seed in range(seeds)]
    return [diagnose([condition(assumed, X, y)], X).surprise for X, y in drawn]


@pytest.mark.thorough
def test_surprises_of_the_process_itself_are_uniform_whatever_chose_the_tasks() -> None:
    assert kstest(surprises(KNOWN, KNOWN), "uniform").pvalue > 1e-3


def test_of_independent_values_the_surprise_is_the_t_tests_of_each_against_those_before() -> None:
    X, y = np.linspace(0, 1, 7)[:, None], np.random.default_rng(3).normal(size=7)
    independent = Hyperparameters(1.5, np.array([np.log(1e-4)]), float(np.log(EXACT)))
    tails = [t(k - 1).sf((y[k] - y[:k].mean()) / (y[:k].std(ddof=1) * np.sqrt(1 + 1 / k))) for k in range(2, len(y))]
    diagnosis = diagnose([condition(independent, X, y)], X)
    assert diagnosis.surprise == pytest.approx(1 - (1 - min(tails)) ** len(tails), rel=1e-6)
    assert diagnosis.trial == 2 + int(np.argmin(tails))


def test_surprises_of_another_process_are_not() -> None:
    rough = Hyperparameters(1.5, np.array([np.log(0.02)]), float(np.log(EXACT)))
    assert kstest(surprises(rough, KNOWN, 100), "uniform").pvalue < 1e-6


def spiked(height: float) -> tuple[np.ndarray, np.ndarray]:
    X = np.append(np.linspace(0, 1, 24), 0.5)[:, None]
    y = np.sin(3 * X[:, 0])
    y[-1] += height
    return X, y


@pytest.mark.parametrize(("height", "believed"), [(0.0, True), (20.0, False)])
def test_a_spike_that_nothing_announced_withdraws_the_bound(height: float, believed: bool) -> None:
    X, y = spiked(height)
    sample = Sample(X, y, ["acquisition"] * len(y), ["completed"] * len(y))
    certificate = DistanceBound().certify_drawn(sample, draw_maxima(sample, draws=12, paths=2), 0.9)
    assert (certificate.doubt is None) == believed
    assert certificate.covers(1e6) == believed
    if not believed:
        assert certificate.doubt is not None
        assert f"trial {len(y) - 1} " in certificate.doubt  # as trials are numbered, from 0
        assert "withdrawn" in certificate.doubt


def test_a_value_that_is_surprisingly_low_withdraws_nothing() -> None:
    X, y = spiked(-5.0)
    assert diagnose([condition(KNOWN, X, y)], X).doubt is None


def test_the_leave_one_out_error_is_that_of_leaving_each_out() -> None:
    rng = np.random.default_rng(1)
    X, hyper = rng.random((9, 2)), Hyperparameters(2.5, np.log([0.5, 0.7]), float(np.log(0.01)))
    y = np.sin(4 * X).sum(axis=1)
    seen = condition(hyper, X, y)
    squares = []
    for row in range(len(y)):
        others = np.arange(len(y)) != row
        K = hyper.kernel(X[others], X[others]) + 0.01 * np.eye(8)
        k = hyper.kernel(X[row : row + 1], X[others])[0]
        mean = seen.mean + k @ np.linalg.solve(K, y[others] - seen.mean)
        variance = seen.scale2 * (1.01 - k @ np.linalg.solve(K, k))
        squares.append((y[row] - mean) ** 2 / variance)
    assert diagnose([seen], X).left_out == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-8)


def test_many_draws_of_hyperparameters_are_averaged() -> None:
    X, y = adaptive(root(KNOWN), np.random.default_rng(2))
    other = Hyperparameters(2.5, np.array([np.log(0.6)]), float(np.log(EXACT)))

    def of(*hypers: Hyperparameters) -> float:
        conditioned: list[Conditioned] = [condition(hyper, X, y) for hyper in hypers]
        return diagnose(conditioned, X).surprise

    low, high = sorted([of(KNOWN), of(other)])
    assert of(KNOWN, KNOWN) == pytest.approx(of(KNOWN))
    assert low - 1e-12 <= of(KNOWN, other) <= high + 0.5


def test_a_surprise_is_a_probability() -> None:
    X, y = spiked(1.0)
    assert 0 <= diagnose([condition(KNOWN, X, y)], X).surprise <= 1


def test_units_do_not_matter() -> None:
    X, y = spiked(1.0)
    plain, moved = (diagnose([condition(KNOWN, X, values)], X) for values in (y, 1000 * y - 7))
    assert moved.surprise == pytest.approx(plain.surprise, rel=1e-3)
    assert (moved.trial, moved.left_out) == (plain.trial, pytest.approx(plain.left_out, rel=1e-3))


# Trials whose order means nothing


def test_left_out_alone_the_surprise_is_the_t_test_of_each_against_all_others() -> None:
    X, y = np.linspace(0, 1, 7)[:, None], np.random.default_rng(3).normal(size=7)
    independent = Hyperparameters(1.5, np.array([np.log(1e-4)]), float(np.log(EXACT)))
    tails = []
    for k in range(7):
        others = np.delete(y, k)
        tails.append(t(5).sf((y[k] - others.mean()) / (others.std(ddof=1) * np.sqrt(1 + 1 / 6))))
    diagnosis = diagnose([condition(independent, X, y)], X, unordered=np.ones(7, dtype=bool))
    assert diagnosis.surprise == pytest.approx(1 - (1 - min(tails)) ** 7, rel=1e-6)
    assert diagnosis.trial == int(np.argmin(tails))


@pytest.mark.thorough
def test_left_out_surprises_of_the_process_itself_are_as_rare_as_stated() -> None:
    found = []
    for seed in range(400):
        rng = np.random.default_rng([6, seed])
        X = rng.random((12, 1))
        K = KNOWN.kernel(X, X) + EXACT * np.eye(12)
        y = np.linalg.cholesky(K) @ rng.normal(size=12)
        found.append(diagnose([condition(KNOWN, X, y)], X, unordered=np.ones(12, dtype=bool)).surprise)
    for level in (0.01, 0.05, 0.2):
        assert np.mean(np.array(found) < level) <= level + 3 * np.sqrt(level * (1 - level) / 400)


@pytest.mark.parametrize("order", ["as they come", "worst first", "worst last", "shuffled"])
def test_a_spike_among_unordered_trials_is_seen_in_any_order(order: str) -> None:
    X, y = spiked(20.0)
    rows = {
        "as they come": np.arange(len(y)),
        "worst first": np.argsort(-y),
        "worst last": np.argsort(y),
        "shuffled": np.random.default_rng(2).permutation(len(y)),
    }[order]
    unordered = np.ones(len(y), dtype=bool)
    found = diagnose([condition(KNOWN, X[rows], y[rows])], X[rows], rows.tolist(), unordered=unordered)
    assert found.trial == len(y) - 1
    assert found.doubt is not None


def test_unordered_trials_are_predicted_from_all_and_the_others_in_order() -> None:
    X, y = adaptive(root(KNOWN), np.random.default_rng(7))
    unordered = np.arange(len(y)) < 4
    seen = [condition(KNOWN, X, y)]
    mixed, all_in_order = diagnose(seen, X, unordered=unordered), diagnose(seen, X)
    assert 0 < mixed.surprise < 1
    assert diagnose(seen, X, unordered=np.zeros(len(y), dtype=bool)).surprise == all_in_order.surprise
