from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates import Options, Sample, TheoremConstants, certify, certify_convergence, rate
from ctxval.errors import CertificateError

positive = st.floats(1e-3, 1e3)
constants = st.builds(TheoremConstants, positive, st.floats(1e-6, 1.0), positive, positive, positive)


def sample(distances: list[float], dimension: int = 1, initial: int = 0) -> Sample:
    n = len(distances)
    states = ["failed" if np.isnan(d) else "completed" for d in distances]
    origins = ["initial"] * initial + ["acquisition"] * (n - initial)
    return Sample(np.full((n, dimension), 0.5), np.array(distances), origins, states)  # type: ignore[arg-type]


@pytest.mark.parametrize(("n", "dimension"), [(1, 1), (25, 1), (100, 2), (500, 11)])
def test_the_rate_is_the_printed_one(n: int, dimension: int) -> None:
    exponent = 3 / (3 + dimension * (dimension + 1))
    assert rate(n, dimension) == pytest.approx(np.sqrt(dimension / n**exponent), rel=1e-12)


@given(st.integers(3, 1000), st.integers(1, 12), st.sampled_from(["matern-3/2", "matern-5/2"]))
def test_more_executions_never_widen_and_dimensions_never_tighten(n: int, dimension: int, kernel: str) -> None:
    assert rate(n + 1, dimension, kernel) <= rate(n, dimension, kernel)  # type: ignore[arg-type]
    assert rate(n, dimension + 1, kernel) >= rate(n, dimension, kernel)  # type: ignore[arg-type]


def test_smoother_kernels_converge_faster_in_the_end() -> None:
    n = 10**13
    assert rate(n, 1, "squared-exponential") < rate(n, 1, "matern-5/2") < rate(n, 1, "matern-3/2")


STATED = TheoremConstants(scale=0.01, noise=0.5, a=1.0, b=1.0, gain=1.0)


def test_corollary_1_validates_where_the_best_is_below_the_threshold_less_the_rate() -> None:
    distances = [0.1, 0.3, 0.2, 0.25]
    certificate = certify_convergence(sample(distances), STATED)
    assert certificate.upper_bound == pytest.approx(0.3 + STATED.constant(4, 1, 0.95) * rate(4, 1))
    assert certificate.covers(certificate.upper_bound)
    assert not certificate.covers(0.3)
    assert "nu > 2" in " ".join(certificate.assumptions)


@pytest.mark.parametrize("constant", [0.0, -1.0, np.nan, np.inf])
def test_a_constant_that_is_no_positive_number_is_refused(constant: float) -> None:
    with pytest.raises(CertificateError, match="constant C"):
        certify_convergence(sample([0.1]), constant)


def test_failures_and_unknown_kernels_are_refused() -> None:
    with pytest.raises(CertificateError, match="from every execution"):
        certify_convergence(sample([0.1, np.nan]), 1.0)
    with pytest.raises(CertificateError, match="not known"):
        rate(3, 1, "cosine")  # type: ignore[arg-type]


def test_only_tasks_that_the_acquisition_function_chose_are_counted() -> None:
    certificate = certify_convergence(sample([0.5, 0.1, 0.3, 0.2], initial=2), constant=0.05)
    assert certificate.upper_bound == pytest.approx(0.5 + 0.05 * rate(2, 1))
    assert (certificate.trials, certificate.details["iterations"]) == (4, 2)
    with pytest.raises(CertificateError, match="none of these was"):
        certify_convergence(sample([0.5, 0.1], initial=2), constant=0.05)


def test_a_bare_constant_validates_nothing() -> None:
    certificate = certify_convergence(sample([0.1, 0.3, 0.2, 0.25]), constant=0.01)
    assert certificate.upper_bound == pytest.approx(0.3 + 0.01 * rate(4, 1))
    assert not certificate.covers(1e9)
    assert certificate.doubt is not None
    assert "C = 0.01 is a number of yours that no theorem and no trial supports" in certificate.doubt


def test_a_search_of_a_fixed_beta_and_fitted_hyperparameters_is_not_covered_by_the_theorem() -> None:
    trials = sample([0.1, 0.3, 0.2, 0.25])
    for options in (Options(theorem=STATED, search="GPUCB"), Options(constant=0.01, search="GPUCB")):
        assert not certify(trials, "convergence", 0.95, options).covers(1e9)
    doubt = certify(trials, "convergence", 0.95, Options(theorem=STATED, search="GPUCB")).doubt
    assert doubt is not None
    assert "fixed beta" in doubt
    assert certify(trials, "convergence", 0.95, Options(theorem=STATED)).covers(1e9)


# The constant


@given(constants, st.integers(1, 500), st.integers(1, 6), st.floats(0.01, 0.999))
def test_the_constant_gives_the_bound_of_the_theorem(
    known: TheoremConstants, n: int, dimension: int, confidence: float
) -> None:
    # Srinivas, Krause, Kakade and Seeger 2012, Theorem 2, written out for the unit cube and a Matern 3/2 kernel.
    d, delta = dimension, 1 - confidence
    inside = max(4 * d * known.a / delta, np.e)  # their logarithm must be positive
    slope = max(n**2 * d * known.b * np.sqrt(np.log(inside)), 1.0)
    beta = 2 * np.log(2 * n**2 * np.pi**2 / (3 * delta)) + 2 * d * np.log(slope)
    information = known.gain * n ** (d * (d + 1) / (3 + d * (d + 1)))
    regret = np.sqrt(8 / np.log(1 + 1 / known.noise) * n * beta * information) + 2
    bound = known.constant(n, dimension, confidence) * rate(n, dimension)
    assert bound > 0
    assert bound == pytest.approx(known.scale * regret / n, rel=1e-9)


@given(constants, st.integers(1, 500), st.floats(0.01, 0.99), st.floats(0.01, 0.99))
def test_more_confidence_never_lowers_the_constant(known: TheoremConstants, n: int, one: float, other: float) -> None:
    low, high = sorted([one, other])
    assert known.constant(n, 2, low) <= known.constant(n, 2, high) * (1 + 1e-12)


def test_a_stated_constant_wins_over_the_computed_one() -> None:
    known = TheoremConstants(scale=1.0, noise=0.01, a=1.0, b=2.0, gain=1.0)
    trials = sample([0.1, 0.3, 0.2, 0.25], initial=1)
    computed = certify(trials, "convergence", 0.9, Options(theorem=known))
    assert computed.upper_bound == pytest.approx(0.3 + known.constant(3, 1, 0.9) * rate(3, 1))
    stated = certify(trials, "convergence", 0.9, Options(constant=0.05, theorem=known))
    assert stated.upper_bound == pytest.approx(0.3 + 0.05 * rate(3, 1))


@pytest.mark.parametrize("name", ["scale", "noise", "a", "b", "gain"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_what_the_theorem_needs_must_be_positive(name: str, value: float) -> None:
    good = {"scale": 1.0, "noise": 0.01, "a": 1.0, "b": 1.0, "gain": 1.0}
    with pytest.raises(CertificateError, match=f"{name} of the theorem"):
        TheoremConstants(**{**good, name: value})
