"""The mapping of a log, in Python and in TOML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval._util.columns import conversion
from ctxval.data import Field, LogMapping, MemoryTable
from ctxval.errors import InputError, UnknownNameError
from facts import refuses

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
torque = { path = "/command.effort", factor = 2.0, held = true }
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
    ("change", "facts"),
    [
        ({"states": {}}, ("log",)),
        ({"observer": 3}, ("observer", 3)),
        ({"observer": {"functon": "a:b"}}, ("observer", "function")),
        ({"observer": "a:b"}, ("observer", "ref", "a:b")),
        ({"states": ["x"]}, ("states", ["x"])),
        ({"states": {"x": {"field": "y"}}}, ("x", "field", "path")),
        ({"observer": {"function": {"ref": "a:b"}, "state": {}}}, ("observer", "state")),
        ({"observer": {"function": {"ref": "a:b"}, "states": {"x": 3}}}, ("states", "x")),
        ({"dt": 0}, ("dt", 0)),
        ({"dt": True}, ("dt", "True")),
        ({"longest_gap": -1}, ("longest_gap", -1)),
        ({"delay": float("inf")}, ("delay", "inf")),
        ({"stamp": "lag"}, ("stamp", "lag", "log")),
        ({"time_unit": "week"}, ("week", "factor")),
        ({"inputs": {"x": "u"}}, ("x",)),
        ({"inputs": 3}, ("inputs", 3)),
        ({"inputs": {"u": 3}}, ("u", 3)),
        ({"inputs": {"u": ""}}, ("field",)),
        ({"inputs": {"u": {"factr": 2}}}, ("u", "factr", "factor")),
        ({"inputs": {"u": {"factor": "2"}}}, ("u", "factor", "2")),
        ({"inputs": {"u": {"recorded": "deg", "unit": "m"}}}, ("u", "deg", "m")),
        (
            {"inputs": {"u": {"recorded": "furlong", "unit": "m"}}},
            ("furlong", "m"),
        ),
        ({"delays": 1}, ("delays",)),
    ],
)
def test_an_unusable_mapping_is_refused(change: dict[str, Any], facts: tuple[object, ...]) -> None:
    with refuses((InputError, UnknownNameError), *facts):
        LogMapping.from_table({"states": {"x": "x"}, **change})


def test_a_mapping_needs_states() -> None:
    with refuses(InputError, "recordings"):
        LogMapping.from_table({"inputs": {"u": "u"}})
    with pytest.raises(UnknownNameError):
        LogMapping.from_table({"state": {"x": "x"}})


@pytest.mark.parametrize(("content", "fact"), [("a = [", "a.toml"), (None, "a.toml")])
def test_a_file_that_is_no_mapping_is_refused(content: str | None, fact: object, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "a.toml").write_text(content)
    with refuses(InputError, fact):
        LogMapping.from_toml(tmp_path / "a.toml")


def test_usual_names_need_no_mapping() -> None:
    columns = {name: np.zeros(3) for name in ("t", "x1", "x0", "u0", "note")}
    usual = LogMapping.usual(MemoryTable("log", columns))
    assert (list(usual.states), list(usual.inputs)) == (["x0", "x1"], ["u0"])
    with refuses(InputError, "log", "note"):
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
