"""The mapping of a log, in Python and in TOML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval._util.columns import conversion
from ctxval.data import Field, LogMapping, MemoryTable
from ctxval.errors import InputError, UnknownNameError

TOML = """
[recordings]
time = "stamp"
time_unit = "ms"
dt = 0.02
delay = 0.04
longest_gap = 0.1

[recordings.states]
angle = { path = "/joint.position[0]", unit = "rad", recorded = "deg", angle = true }
rate = "/joint.velocity[0]"

[recordings.inputs]
torque = { field = "/command.effort", factor = 2.0, held = true }
"""


def test_a_mapping_in_toml_is_that_in_python(tmp_path: Path) -> None:
    path = tmp_path / "mapping.toml"
    path.write_text(TOML)
    expected = LogMapping(
        {
            "angle": Field("/joint.position[0]", unit="rad", recorded="deg", angle=True),
            "rate": Field("/joint.velocity[0]"),
        },
        {"torque": Field("/command.effort", factor=2.0, held=True)},
        time="stamp",
        time_unit="ms",
        dt=0.02,
        delay=0.04,
        longest_gap=0.1,
    )
    assert LogMapping.from_toml(path) == expected
    path.write_text(TOML.replace("[recordings]", "").replace("[recordings.", "["))
    assert LogMapping.from_toml(path) == expected


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"states": {}}, "a mapping of a log needs at least one state"),
        ({"observer": 3}, "an observer must name a function module:attr, got 3"),
        ({"observer": {"functon": "a:b"}}, "an observer must name a function module:attr"),
        ({"observer": {"function": "a:b", "state": {}}}, "no entry of the observer is called 'state'"),
        ({"observer": {"function": "a:b", "states": {"x": 3}}}, "states must be"),
        ({"dt": 0}, "dt must be a positive number of seconds, got 0"),
        ({"dt": True}, "dt must be a positive number of seconds, got True"),
        ({"longest_gap": -1}, "longest_gap must be a positive number"),
        ({"delay": float("inf")}, "delay must be a finite number"),
        ({"stamp": "lag"}, "no stamp is called 'lag'; did you mean 'log'"),
        ({"time_unit": "week"}, "no known factor from week to s"),
        ({"inputs": {"x": "u"}}, "x is a state and an input: give them different names"),
        ({"inputs": 3}, "inputs must be a table of fields or a list of paths, got 3"),
        ({"inputs": {"u": 3}}, "the field u must be a path or a table, got 3"),
        ({"inputs": {"u": ""}}, "the path of a field must be a text, got ''"),
        ({"inputs": {"u": {"factr": 2}}}, "entry of the field u is called 'factr'; did you mean 'factor'"),
        ({"inputs": {"u": {"factor": "2"}}}, "the field u: factor must be a finite number, got '2'"),
        ({"inputs": {"u": {"recorded": "deg", "unit": "m"}}}, "the field u: there is no known factor from deg to m"),
        (
            {"inputs": {"u": {"recorded": "furlong", "unit": "m"}}},
            "there is no known factor from furlong to m: give fac",
        ),
        ({"delays": 1}, "no entry of the mapping of recordings is called 'delays'; did you mean 'delay'"),
    ],
)
def test_an_unusable_mapping_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        LogMapping.from_table({"states": {"x": "x"}, **change})


def test_a_mapping_needs_states() -> None:
    with pytest.raises(InputError, match="needs states"):
        LogMapping.from_table({"inputs": ["u"]})
    with pytest.raises(UnknownNameError):
        LogMapping.from_table({"state": ["x"]})


@pytest.mark.parametrize(("content", "message"), [("a = [", "is not valid TOML"), (None, "cannot be read")])
def test_a_file_that_is_no_mapping_is_refused(content: str | None, message: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "a.toml").write_text(content)
    with pytest.raises(InputError, match=message):
        LogMapping.from_toml(tmp_path / "a.toml")


def test_usual_names_need_no_mapping() -> None:
    columns = {name: np.zeros(3) for name in ("t", "x1", "x0", "u0", "note")}
    usual = LogMapping.usual(MemoryTable("log", columns))
    assert (list(usual.states), list(usual.inputs)) == (["x0", "x1"], ["u0"])
    with pytest.raises(InputError, match=r"log has no states under a usual name .* the fields are t, note"):
        LogMapping.usual(MemoryTable("log", {"t": np.zeros(3), "note": np.zeros(3)}))


@pytest.mark.parametrize(
    ("recorded", "wanted", "factor"),
    [
        ("deg", "rad", np.pi / 180),
        ("rpm", "deg/s", 6.0),
        ("mm", "m", 1e-3),
        ("N m", "N·m", 1.0),
        ("N m", "Nm", 1.0),
        ("km/h", "m/s", 1 / 3.6),
        ("g", "m/s²", 9.80665),
        ("counts", "counts", 1.0),
        ("ns", "s", 1e-9),
    ],
)
def test_factors_between_units(recorded: str, wanted: str, factor: float) -> None:
    assert conversion(recorded, wanted) == pytest.approx(factor, rel=1e-12)
    assert conversion(wanted, recorded) == pytest.approx(1 / factor, rel=1e-12)
