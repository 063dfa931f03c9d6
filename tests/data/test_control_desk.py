"""Recordings of dSPACE ControlDesk: structures with several time axes in MATLAB files of both kinds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from ctxval.data import Clock, Field, LogMapping, read_logs, read_recordings
from ctxval.data.matlab import ControlDeskLog, is_control_desk
from ctxval.errors import InputError
from facts import refuses
from rig_logs import DT, run, write_control_desk

ONE = run()
MAPPING = LogMapping({"position": "position", "speed": "speed"}, {"force": "force"}, dt=DT)


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_signals_have_their_names_units_and_times(version: str, tmp_path: Path) -> None:
    write_control_desk(tmp_path / "a.mat", ONE, version=version)
    (log,) = read_logs([tmp_path / "a.mat"])
    assert log.fields() == ("position", "speed", "force")
    signals = log.signals(log.fields(), Clock())
    assert [signals[name].unit for name in log.fields()] == ["m", "m/s", "N"]
    assert signals["position"].times is signals["speed"].times
    assert len(signals["force"].times) == 2 * ONE.horizon
    recordings = read_recordings([tmp_path / "a.mat"], MAPPING)
    (part,) = recordings.runs
    kept = part.trajectory.horizon
    assert kept >= ONE.horizon - 1  # a command holds until the next sample
    assert part.trajectory.states == pytest.approx(ONE.states[: kept + 1])
    assert part.trajectory.inputs == pytest.approx(ONE.inputs[:kept])
    assert (recordings.states, recordings.inputs) == ({"position": "m", "speed": "m/s"}, {"force": "N"})


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_a_single_signal_is_no_array_of_structures(version: str, tmp_path: Path) -> None:
    write_control_desk(tmp_path / "a.mat", ONE, version=version, alone=True)
    (log,) = read_logs([tmp_path / "a.mat"])
    signal = log.signals(["position"], Clock())["position"]
    assert signal.values[:, 0] == pytest.approx(ONE.states[:, 0])
    assert signal.times == pytest.approx(ONE.times)


def test_whole_paths_are_fields_too(tmp_path: Path) -> None:
    write_control_desk(tmp_path / "a.mat", ONE)
    mapping = LogMapping({"x": Field("Model Root/Plant/position", unit="cm")}, dt=DT)
    states = read_recordings([tmp_path / "a.mat"], mapping).runs[0].trajectory.states
    assert states[:, 0] == pytest.approx(100 * ONE.states[:, 0])
    with refuses(InputError, "Plant", "position"):
        read_recordings([tmp_path / "a.mat"], LogMapping({"x": "Plant"}))
    with refuses(InputError, "time", "a.mat"):
        read_recordings([tmp_path / "a.mat"], LogMapping({"x": "position"}, time="t"))


def structure(**changes: Any) -> dict[str, Any]:
    axes = [{"Data": np.arange(4.0), "Raster": "slow"}, {"Data": np.arange(8.0), "Raster": "fast", "Unit": "ms"}]
    signals = [
        {"Name": "Root/A/y", "Data": np.arange(4.0), "XIndex": 1},
        {"Name": "Root/B/y", "Data": np.arange(8), "XIndex": 2, "Unit": "-"},
        {"Name": "Root/pair", "Data": np.ones((2, 4)), "XIndex": 1},
        {"Name": "none", "Data": np.zeros(0), "XIndex": 1},
    ]
    return {"X": axes, "Y": signals, **changes}


def test_names_are_as_long_as_they_must_be() -> None:
    log = ControlDeskLog("a", structure())
    assert log.fields() == ("Root/A/y", "Root/B/y", "pair")
    signals = log.signals(["Root/B/y", "pair", "pair[1]"], Clock())
    assert signals["Root/B/y"].times == pytest.approx(1e-3 * np.arange(8))
    assert signals["Root/B/y"].unit == ""
    assert (signals["pair"].values.shape, signals["pair[1]"].values.shape) == ((4, 2), (4, 1))
    with refuses(InputError, 2, "pair[2]"):
        log.signals(["pair[2]"], Clock())


def test_a_signal_on_two_rasters_has_two_names() -> None:
    twice = [{"Name": "y", "Data": np.arange(n), "XIndex": k, "Raster": raster} for n, k, raster in
             ((4, 1, "slow"), (8, 2, "fast"))]  # fmt: skip
    log = ControlDeskLog("a", structure(Y=twice))
    assert log.fields() == ("slow/y", "fast/y")
    by_raster = [{"Name": "y", "Data": np.arange(8), "Raster": "fast"}]
    assert len(ControlDeskLog("a", structure(Y=by_raster)).signals(["y"], Clock())["y"].times) == 8


@pytest.mark.parametrize(
    ("signal", "facts"),
    [
        ({"Name": "y", "Data": np.arange(4), "XIndex": 3}, ("y", 1, 2)),
        ({"Name": "y", "Data": np.arange(5), "XIndex": 1}, ("y", 4, "X")),
    ],
)
def test_signals_that_do_not_fit_are_refused(signal: dict[str, Any], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        ControlDeskLog("a", structure(Y=[signal])).signals(["y"], Clock())


def test_times_must_be_finite() -> None:
    axes = [{"Data": np.array([0.0, np.nan, 2.0, 3.0])}]
    with refuses(InputError, "X", 1):
        ControlDeskLog("a", structure(X=axes, Y=structure()["Y"][:1])).signals(["y"], Clock())


def test_other_structures_are_read_as_before(tmp_path: Path) -> None:
    assert not is_control_desk({"X": {"Data": np.arange(3.0)}, "Y": {"Data": np.arange(3.0)}})
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["s/X/Data"] = np.arange(3.0)
        file["s/Y/Data"] = np.arange(3.0)
    (log,) = read_logs([tmp_path / "a.mat"])
    assert not isinstance(log, ControlDeskLog)
    assert log.fields() == ("s.X.Data", "s.Y.Data")


def test_several_recordings_in_a_file_are_several_logs(tmp_path: Path) -> None:
    write_control_desk(tmp_path / "a.mat", ONE, name="first")
    write_control_desk(tmp_path / "b.mat", ONE, name="second")
    with h5py.File(tmp_path / "a.mat", "a") as file, h5py.File(tmp_path / "b.mat") as other:
        other.copy("second", file, expand_refs=False)
        del file["second/Y"]
        other.copy("second/X", file["second"], name="Z")
        group = file["second"].create_group("Y")
        for field in ("Name", "Data"):
            group[field] = file["#refs#"][f"Y{field}0"]
        del file["second/X"]
        file["second"].create_group("X")["Data"] = file["#refs#/XData0"]
    logs = read_logs([tmp_path / "a.mat"])
    assert [log.source.rpartition(", ")[2] for log in logs] == ["first", "second"]


def test_a_reference_leads_only_to_what_was_checked(tmp_path: Path) -> None:
    write_control_desk(tmp_path / "a.mat", ONE)
    with h5py.File(tmp_path / "a.mat", "a") as file:
        deep = file["#refs#"].create_group("a/b/c/d/e/f/g")
        outside = deep.create_dataset("z", (60,), "f8", external=[(str(tmp_path / "other"), 0, 480)])
        file["rec1/Y/Data"][0, 0] = outside.ref
    (log,) = read_logs([tmp_path / "a.mat"])
    assert log.fields() == ("speed", "force")
    with h5py.File(tmp_path / "a.mat", "a") as file:
        file["#refs#/z"] = file["#refs#/a/b/c/d/e/f/g/z"]
    with refuses(InputError, "a.mat"):
        read_logs([tmp_path / "a.mat"])


def test_cells_in_a_structure_are_no_signals(tmp_path: Path) -> None:
    write_control_desk(tmp_path / "a.mat", ONE)
    with h5py.File(tmp_path / "a.mat", "a") as file:
        kept = file["rec1/Y/Data"][:2]
        del file["rec1/Y/Data"]
        file["rec1/Y"].create_dataset("Data", (2, 1), h5py.ref_dtype)[:] = kept
    (log,) = read_logs([tmp_path / "a.mat"])
    assert not isinstance(log, ControlDeskLog)
