from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates import is_validated, rate
from ctxval.errors import InputError, UnknownNameError
from facts import refuses


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


@given(st.floats(0, 10), st.floats(0.01, 10), st.integers(1, 500), st.integers(1, 6))
def test_corollary_1_validates_if_the_best_is_below_the_threshold_less_the_rate(
    best: float, constant: float, n: int, dimension: int
) -> None:
    bound = best + constant * rate(n, dimension)
    assert is_validated(best, bound * (1 + 1e-9), constant, n, dimension)
    assert not is_validated(best, bound * (1 - 1e-9), constant, n, dimension)


@pytest.mark.parametrize("constant", [0.0, -1.0, np.nan, np.inf])
def test_a_constant_that_is_no_positive_number_is_refused(constant: float) -> None:
    with refuses(InputError, "constant"):
        is_validated(0.1, 1.0, constant, 3, 1)


def test_unknown_kernels_are_refused() -> None:
    with refuses(UnknownNameError, "cosine", 2):
        rate(3, 1, "cosine")  # type: ignore[arg-type]
