"""Which column of a table is meant, and what stands for a missing value."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Trajectory
from ctxval._util.arrays import held_means
from ctxval._util.columns import (
    column_of,
    conversion,
    in_seconds,
    named_unit,
    sentinels,
    time_column,
    unit_advice,
)
from ctxval._util.tables import CsvTable
from ctxval.data import LogMapping, read_recordings
from ctxval.errors import InputError
from facts import assert_names, refuses


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
    with refuses(InputError, "angle_deg", "angle_rad"):
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
    with refuses(InputError, "times", "deg"):
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


# The one reader of CSV files


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_the_separator_is_found_in_the_header(separator: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f'\n"x,y;z"{separator}t\n1{separator}2\n\n   \n3{separator}4\n')
    table = CsvTable(tmp_path / "a.csv")
    assert table.names == ("x,y;z", "t")
    assert [(line, [float(cell) for cell in row]) for line, row in table.rows()] == [(3, [1, 2]), (6, [3, 4])]


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("t,x0,u0,x0\n0,1,2,3\n1,1,,3\n", ("a.csv", "x0")),
        ("t,x0 [m],u0,x0 [mm]\n0,1,2,3\n1,1,,3\n", ("a.csv", "x0")),
        (
            "t,x0,u0\n0,1,0,2,0\n0,1,1,0,\n",
            ("a.csv", 2, "row", 3),
        ),
        ("t,x0,u0\n0,1,2\n1,1\n2,1,\n", ("a.csv", 3, "row", 2)),
        ("t;x0;u0\n0,0;1,5;2\n0.5;1,5;\n", ()),
        ("t;x0;u0\n0;1.234,5;2\n1;1;\n", ("a.csv", 2, "x0", "1.234,5")),
        ("t,x0,u0\n0,1_0,2\n1,1,\n", ("a.csv", 2, "x0", "1_0")),
    ],
)
def test_a_table_that_could_be_misread_is_refused_by_all_readers(
    text: str, facts: tuple[object, ...], tmp_path: Path
) -> None:
    (tmp_path / "a.csv").write_text(text)
    mapping = LogMapping.from_table({"states": {"x0": "x0"}, "inputs": {"u0": "u0"}})
    for read in (
        Trajectory.from_csv,
        lambda path: read_recordings([path]),
        lambda path: read_recordings([path], mapping),
    ):
        with pytest.raises(InputError) as caught:
            read(tmp_path / "a.csv")
        assert_names(str(caught.value), *facts)


def test_decimal_commas_are_read_between_semicolons(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t;x0 [mm];u0\n0,0;1,5;-2e-1\n0,1;2,5;\n")
    one = Trajectory.from_csv(tmp_path / "a.csv", states=["x0 [m]"], inputs=["u0"])
    assert one.times.tolist() == [0, 0.1]
    assert one.states[:, 0].tolist() == pytest.approx([0.0015, 0.0025])
    assert one.inputs.tolist() == [[-0.2]]


def test_a_file_with_several_recordings_is_no_trajectory(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x0,u0,episode\n0,1,2,0\n1,1,2,0\n2,5,2,1\n")
    with refuses(InputError, "a.csv", "file"):
        Trajectory.from_csv(tmp_path / "a.csv")


# Units, and the names of columns that state them


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
    with refuses(InputError, recorded, wanted):
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
        ("t__ms_", "t", "ms"),
        ("t__ms", "t", "ms"),
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
