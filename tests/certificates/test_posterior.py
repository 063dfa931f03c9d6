from __future__ import annotations

import json

import numpy as np
import pytest

from ctxval import Trial
from ctxval.certificates import MadeGood, Maxima, Sample, certify_posterior, draw_maxima
from ctxval.errors import CertificateError


def sample(n: int = 9, d: int = 1, origin: str = "acquisition", factor: float = 1.0) -> Sample:
    rng = np.random.default_rng([n, d])
    X = rng.random((n, d))
    y = factor * (1.5 + np.sin(6 * X).sum(axis=1))
    return Sample(X, y, [origin] * n, ["completed"] * n)  # type: ignore[list-item]


def quick(trials: Sample, seed: int = 0, stochastic: bool = False) -> Maxima:
    return draw_maxima(trials, draws=10, paths=4, seed=seed, stochastic=stochastic)


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
    certificate = certify_posterior(made_good(None), 0.9, found=found, resolution=1)
    assert not certificate.covers(1e9)
    assert certificate.doubt is not None
    assert "trial 2 failed and trial 7 executed the same task with success, for no stated reason" in certificate.doubt
    assert '--again 2 --because "what was changed"' in certificate.doubt
    explained = certify_posterior(made_good("fuse replaced"), 0.9, found=found, resolution=1)
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
            made = certify_posterior(trials, 0.8, found=maxima)
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
                certify_posterior(trials, 0.8, found=draw_maxima(trials, draws=12, paths=1)).doubt is not None
            )
    assert fired["worst first"] == 0
    assert fired["unordered"] >= max(4, fired["in order"])
