"""Which column of a table is meant, and what stands for a missing value."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval._util.arrays import held_means
from ctxval._util.columns import column_of, in_seconds, sentinels, time_column, unit_advice
from ctxval.errors import InputError


def test_a_column_is_found_with_and_without_its_unit() -> None:
    names = ("t_ms", "angle [deg]", "rate_deg_s", "x_m", "v")
    assert column_of("a", names, "angle") == ("angle [deg]", "deg")
    assert column_of("a", names, "angle [deg]") == ("angle [deg]", "deg")
    assert column_of("a", names, "rate") == ("rate_deg_s", "deg/s")
    assert column_of("a", names, "x") == ("x_m", "m")
    assert column_of("a", names, "x_m") == ("x_m", "")  # perhaps a measured x
    assert column_of("a", names, "v [mm/s]") == ("v", "mm/s")
    assert column_of("a", names, "angle [rad]") is None
    assert column_of("a", names, "w") is None
    with pytest.raises(InputError, match="a has several columns for angle: angle_deg, angle_rad; name one"):
        column_of("a", ("angle_deg", "angle_rad"), "angle")


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("time", "t"), ("t", "")),
        (("Time [ms]", "x"), ("Time [ms]", "ms")),
        (("time_s", "x"), ("time_s", "s")),
        (("timestamp_ns", "x"), ("timestamp_ns", "ns")),
        (("T", "x"), None),
    ],
)
def test_the_column_of_times_is_found(names: tuple[str, ...], found: tuple[str, str] | None) -> None:
    assert time_column("a", names) == found


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_since_1970_are_recognised_by_their_size(unit: str, factor: float) -> None:
    times = 1.7e9 + 0.02 * np.arange(5)
    np.testing.assert_allclose(in_seconds("a", times * factor, ""), times, rtol=1e-12)
    np.testing.assert_allclose(in_seconds("a", times * factor, unit), times, rtol=1e-12)
    np.testing.assert_array_equal(in_seconds("a", times, ""), times)
    assert f"t [{unit}]" in unit_advice(0.02 * factor, 0.02)
    assert unit_advice(0.02, 0.02 * 2.5) == unit_advice(0.1, 0.02) == ""
    with pytest.raises(InputError, match="a: the unit of its times must be s, ms, us, ns, min or h, got 'deg'"):
        in_seconds("a", times, "deg")


@pytest.mark.parametrize("mark", [-999.0, -9999.0, 1e9, 999.9, -32768.0, 1e38, -99999.0])
def test_marks_far_outside_the_rest_are_noticed(mark: float) -> None:
    values = np.sin(np.arange(50.0))
    values[[3, 4, 20]] = mark
    assert sentinels(values) == [mark]
    assert sentinels(np.append(values, np.nan)) == [mark]
    assert sentinels(values.astype(np.float32)) == [float(np.float32(mark))]


def test_marks_that_were_converted_with_the_rest_are_noticed() -> None:
    values = np.append(np.sin(np.arange(50.0)), -999.0)
    for factor in (3.6, 1e3, 1 / 0.0254, np.rad2deg(1)):
        assert sentinels(factor * values, 1 / factor) == [factor * -999.0]
        assert sentinels(values, factor) == [-999.0]
        assert sentinels(factor * values) == []
    assert sentinels(np.append(np.zeros(50), 1e3), 1e3) == [], "a force of 1 kN is no mark, though it is 1e6 mN"


@given(arrays(np.float64, st.integers(0, 30), elements=st.floats(-90, 90)))
def test_ordinary_values_stand_for_themselves(values: np.ndarray) -> None:
    assert sentinels(values) == []
    assert sentinels(np.append(np.linspace(990, 1000, 11), 999.0)) == []


@given(
    steps=st.lists(st.floats(0.01, 0.3), min_size=1, max_size=30),
    dt=st.floats(0.02, 0.5),
    offset=st.floats(0, 1),
    data=st.data(),
)
def test_means_of_held_values_are_their_integrals(
    steps: list[float], dt: float, offset: float, data: st.DataObject
) -> None:
    times = np.cumsum([0.0, *steps])
    values = data.draw(arrays(np.float64, (len(times), 2), elements=st.floats(-3, 3)))
    edges = offset + dt * np.arange(5)
    fine = (edges[:-1, None] + dt * (np.arange(4000) + 0.5) / 4000).ravel()
    held = values[np.searchsorted(times, fine, side="right") - 1].reshape(4, 4000, 2)
    np.testing.assert_allclose(held_means(times, values, edges, 0.0), held.mean(axis=1), atol=6 * len(times) / 4000)
