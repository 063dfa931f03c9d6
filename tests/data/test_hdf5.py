"""HDF5 files: demonstrations of robomimic, and arrays with a time."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from ctxval.data import LogMapping, read_logs, read_recordings
from ctxval.errors import InputError
from facts import refuses
from rig_logs import run

RUNS = [run(30, seed=seed) for seed in range(11)]


@pytest.fixture
def demonstrations(tmp_path: Path) -> Path:
    """Return a file in the form of robomimic, https://robomimic.github.io/docs/datasets/overview.html."""
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Cart", "env_kwargs": {"control_freq": 20}})
        for number, one in enumerate(RUNS):
            group = data.create_group(f"demo_{number}")
            group.create_dataset("actions", data=one.inputs, compression="gzip")
            group["states"], group["dones"] = one.states[:-1], np.zeros(30)
            group["obs/position"], group["obs/image"] = one.states[:-1, 0], np.zeros((30, 4, 4, 3), dtype=np.uint8)
    return tmp_path / "demo.hdf5"


def test_demonstrations_of_robomimic_are_recordings_with_their_step(demonstrations: Path) -> None:
    logs = read_logs([demonstrations])
    assert [log.source.rpartition("demo_")[2] for log in logs] == [str(number) for number in range(11)]
    assert set(logs[0].fields()) == {"actions", "states", "dones", "obs.position"}
    recordings = read_recordings([demonstrations])
    assert recordings.dt == pytest.approx(0.05)
    for found, one in zip(recordings.runs, RUNS, strict=True):
        np.testing.assert_allclose(found.trajectory.states, one.states[:-1], atol=1e-9)
        np.testing.assert_allclose(found.trajectory.inputs, one.inputs[:-1], atol=1e-9)
    mapping = {"states": {"position": "obs.position"}, "inputs": {"force": "actions[0]"}}
    of_position = read_recordings([demonstrations], LogMapping.from_table(mapping)).runs[3].trajectory
    np.testing.assert_allclose(of_position.states[:, 0], RUNS[3].states[:-1, 0], atol=1e-9)


def test_arrays_with_a_time_are_one_recording(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"], file["x"], file["u"] = RUNS[0].times, RUNS[0].states, np.vstack([RUNS[0].inputs, np.zeros((1, 1))])
    (found,) = read_recordings([tmp_path / "a.h5"]).runs
    np.testing.assert_allclose(found.trajectory.states, RUNS[0].states, atol=1e-9)


def test_files_without_arrays_and_files_that_lead_elsewhere_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["name"] = "cart"
    with refuses(InputError, "a.h5"):
        read_logs([tmp_path / "a.h5"])
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = h5py.ExternalLink("/etc/passwd", "/x")
    with refuses(InputError, "b.h5", "x"):
        read_logs([tmp_path / "b.h5"])
    (tmp_path / "c.hdf5").write_bytes(b"no such file")
    with refuses(InputError, "c.hdf5"):
        read_logs([tmp_path / "c.hdf5"])
