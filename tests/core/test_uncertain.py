"""Priors of parameters that are not known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.core.uncertain import UncertainParameter, prior_of, priors_of, uncertain_in
from ctxval.errors import InputError
from ctxval.models import Linear
from facts import refuses


@given(st.floats(0.1, 10.0), st.floats(0.01, 1.0), st.booleans())
def test_zero_is_the_value_of_the_model_and_more_is_more(value: float, deviation: float, relative: bool) -> None:
    parameter = UncertainParameter("mass", value, deviation, relative)
    low, middle, high = parameter.at(np.array([-1.0, 0.0, 1.0])).tolist()
    assert middle == value
    assert low < middle < high


def test_a_share_multiplies_and_a_number_is_added() -> None:
    assert prior_of("mass", 2.0, "20 %").at(np.array(1.0)) == pytest.approx(2.0 * np.exp(0.2))
    assert prior_of("wind", 0.0, 1.5).at(np.array(-2.0)) == pytest.approx(-3.0)
    assert UncertainParameter("drag", 0.1, 0.2, False, low=0.0).at(np.array(-1.0)) == 0.0


@pytest.mark.parametrize(("value", "deviation"), [(1.0, -0.1), (1.0, "0 %"), (1.0, "much"), (0.0, "10 %"), (1.0, 0)])
def test_what_is_no_deviation_is_refused(value: float, deviation: float | str) -> None:
    with refuses(InputError, "mass", deviation):
        prior_of("mass", value, deviation)


def test_names_must_be_parameters() -> None:
    with refuses(InputError, "weight", "mass"):
        priors_of({"mass": 1.0}, {"weight": "10 %"})
    assert priors_of({"mass": 1.0}, None) == ()


def test_a_model_without_uncertain_parameters_has_none() -> None:
    assert uncertain_in(Linear(np.eye(2), np.ones((2, 1)))) is None
