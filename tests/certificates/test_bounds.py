from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval._util.texts import as_text
from ctxval.certificates.bounds import at_most, with_error
from facts import assert_names


@pytest.mark.parametrize(
    ("upper", "error", "text"),
    [
        (0.43211, 0.0, "0.4322"),
        (0.43221, 0.000001, "0.4323"),
        (0.4322, 0.013, "0.433 ± 0.013"),
        (0.4322, 0.024, "0.44 ± 0.03"),
        (0.43211, 0.00014, "0.4322 ± 0.0002"),
        (0.4322, 0.6, "0.5 ± 0.6"),
        (123.4, 17.2, "124 ± 18"),
        (0.04, 3.0, "0.04 ± 3"),
        (0.0, 0.02, "0 ± 0.02"),
        (float("inf"), 0.1, "inf"),
    ],
)
def test_a_bound_has_as_many_digits_as_its_error_supports(upper: float, error: float, text: str) -> None:
    assert with_error(upper, error) == text


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 10))
def test_neither_bound_nor_error_is_rounded_down_nor_far_up(upper: float, share: float) -> None:
    error = share * upper
    first, _, second = with_error(upper, error).partition(" ± ")
    assert float(first) >= upper * (1 - 1e-12)
    if second:
        assert float(first) <= upper + max(error, 1e-3 * upper) * (1 + 1e-9)
        assert error * (1 - 1e-12) <= float(second) <= max(2 * error, error + 1e-3 * upper)


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


def test_numbers_are_told_with_four_digits() -> None:
    details = {"best": 0.123456, "gap": None, "scales": [0.5, 2.0], "counted": {"draws": 59, "stochastic": False}}
    assert_names(as_text(details), "best", 0.1235, "gap", "scales")
