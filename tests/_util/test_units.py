"""Units, and the names of columns that state them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval._util.columns import conversion, named_unit
from ctxval.errors import InputError


@pytest.mark.parametrize(
    ("recorded", "wanted", "factor"),
    [
        ("deg", "rad", math.pi / 180),
        ("°/s²", "rad/s^2", math.pi / 180),
        ("rpm", "rad/s", math.pi / 30),
        ("rev/min", "rpm", 1.0),
        ("N m", "Nm", 1.0),
        ("mN·m", "N m", 1e-3),
        ("kg m/s^2", "N", 1.0),
        ("km/h", "m/s", 1 / 3.6),
        ("mm/s2", "m/s^2", 1e-3),
        ("g", "m/s^2", 9.80665),
        ("usec", "s", 1e-6),
        ("furlong", "furlong", 1.0),
    ],
)
def test_units_are_converted(recorded: str, wanted: str, factor: float) -> None:
    assert conversion(recorded, wanted) == pytest.approx(factor, rel=1e-14)
    assert conversion(wanted, recorded) == pytest.approx(1 / factor, rel=1e-14)


@pytest.mark.parametrize(
    ("recorded", "wanted"),
    [("Hz", "rad/s"), ("deg", ""), ("deg", "1"), ("mg", "m/s^2"), ("m/s kg", "N"), ("ms", "m/s"), ("furlong", "m")],
)
def test_units_that_do_not_measure_the_same_are_refused(recorded: str, wanted: str) -> None:
    with pytest.raises(InputError, match="no known factor"):
        conversion(recorded, wanted)


@pytest.mark.parametrize(
    ("column", "name", "unit"),
    [
        ("angle [deg]", "angle", "deg"),
        ("angle[deg]", "angle", "deg"),
        ("time (us)", "time", "us"),
        ("rate_deg_s", "rate", "deg/s"),
        ("a_m_per_s2", "a", "m/s^2"),
        ("t_ms", "t", "ms"),
        ("x[2]", "x[2]", ""),
        ("x_min", "x_min", ""),
        ("state", "state", ""),
        ("torque [N m]", "torque", "N m"),
    ],
)
def test_a_column_states_its_unit(column: str, name: str, unit: str) -> None:
    assert named_unit(column)[:2] == (name, unit)


@given(st.text(max_size=300))
def test_every_name_is_read(column: str) -> None:
    name, unit, weak = named_unit(column)
    assert len(name) + len(unit) <= len(column) + 2
    assert unit or not weak
