from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates import Sample, certify_convergence, rate
from ctxval.errors import CertificateError


def sample(distances: list[float], dimension: int = 1) -> Sample:
    n = len(distances)
    states = ["failed" if np.isnan(d) else "completed" for d in distances]
    return Sample(np.full((n, dimension), 0.5), np.array(distances), ["acquisition"] * n, states)  # type: ignore[arg-type]


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


def test_corollary_1_validates_where_the_best_is_below_the_threshold_less_the_rate() -> None:
    distances = [0.1, 0.3, 0.2, 0.25]
    certificate = certify_convergence(sample(distances), constant=0.05)
    assert certificate.upper_bound == pytest.approx(0.3 + 0.05 * rate(4, 1))
    assert certificate.covers(0.4)
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
