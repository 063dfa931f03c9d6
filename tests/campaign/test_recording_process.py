"""Files of strangers: they lead nowhere, need little memory, and learn nothing of the user."""

from __future__ import annotations

import os
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval._util.cores import may_confine
from ctxval.campaign.telling import SuppliedResult
from ctxval.core.trajectory import Trajectory
from ctxval.data import LogMapping
from ctxval.errors import InputError
from facts import assert_names, refuses
from rig_logs import run, write_bag, write_bag1, write_mat, write_mcap_json, write_parquet
from rig_thorough import more, some

CANARY = "canary-7c1d"
ONE = run(20)

FIELDS = {
    "run.csv": None,
    "run.npz": None,
    "run.mat": {"states": {"s": "log.state"}, "inputs": {"force": "force"}, "time": "log.time"},
    "run.parquet": {"states": {"position": "position", "speed": "speed"}, "inputs": {"force": "force"}},
    "run.mcap": {
        "states": {"position": "/state.cart.position", "speed": "/state.cart.speed[0]"},
        "inputs": {"force": "/command.force"},
    },
    "run.bag": {
        "states": {"position": "/joints.position[0]", "speed": "/joints.velocity[0]"},
        "inputs": {"force": "/joints.effort[0]"},
    },
}


def read(path: Path, *, confined: bool = True, uploaded: bool = True) -> Trajectory:
    table = FIELDS.get(path.name)
    mapping = None if table is None else LogMapping.from_table(table)
    named = {"position": "m", "speed": "m/s"}, {"force": "N"}
    told = SuppliedResult(path, mapping=mapping, uploaded=uploaded)
    return (told.read_confined if confined else told.read_file)(path, *named, ONE.times)


def write(path: Path) -> None:
    match path.suffix:
        case ".csv":
            ONE.to_csv(path, states=["position [m]", "speed [m/s]"], inputs=["force [N]"])
        case ".npz":
            path.write_bytes(ONE.to_npz())
        case ".mat":
            write_mat(path, ONE, version="7.3")
        case ".parquet":
            write_parquet(path, ONE)
        case ".mcap":
            write_mcap_json(path, ONE)
        case ".bag":
            write_bag1(path, ONE)


@pytest.mark.slow
@pytest.mark.parametrize("name", some(FIELDS, 2))
def test_a_confined_process_reads_what_this_one_reads(name: str, tmp_path: Path) -> None:
    write(tmp_path / name)
    found = read(tmp_path / name)
    np.testing.assert_array_equal(found.states, read(tmp_path / name, confined=False).states)


@pytest.mark.slow
def test_the_storage_of_a_bag_is_read_in_a_confined_process(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", ONE)
    (storage,) = (tmp_path / "bag").glob("*.db3")
    FIELDS[storage.name] = FIELDS["run.bag"]
    assert read(storage).horizon == ONE.horizon


class Probe(SuppliedResult):
    """Does what an attacker would do who took over the process; what it learns is in the reason of the failure."""

    def read_file(self, file: Path, *_: Any) -> None:  # type: ignore[override]
        learned = []
        for path in (file.with_name("key"), Path("/etc/passwd"), Path("/proc/self/environ"), Path.home()):
            try:
                learned.append(os.listdir(path) if path.is_dir() else path.read_bytes())
            except OSError:
                continue
        for path in (file, file.with_name("new")):
            try:
                path.write_text("changed")
                learned.append(path)
            except OSError:
                continue
        learned += [value for value in os.environ.values() if CANARY in value]
        raise InputError(f"learned: {learned}")


@pytest.mark.slow
@pytest.mark.skipif(not may_confine(), reason="this system cannot take rights away from a process")
def test_a_process_that_is_taken_over_learns_and_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROBOT_PASSWORD", CANARY)
    packages = [str(Path(__file__).parent), str(Path(__file__).parents[1]), str(tmp_path)]  # the last one has the home
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(packages))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    (tmp_path / "key").write_text(CANARY)
    (tmp_path / "run.csv").write_text("t,position")
    probe = Probe(tmp_path / "run.csv")
    monkeypatch.setattr(sys.modules[__name__], "__name__", "test_recording_process")
    monkeypatch.setattr(Probe, "__module__", "test_recording_process")
    monkeypatch.setitem(sys.modules, "test_recording_process", sys.modules[Probe.__module__])
    assert pickle.loads(pickle.dumps(probe)).recording == probe.recording
    with refuses(InputError, []):
        probe.read_confined(tmp_path / "run.csv", {"position": "m"}, {}, ONE.times)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["home", "key", "run.csv"]


class Greedy(Probe):
    """Needs more than it may have."""

    def read_file(self, *_: Any) -> None:  # type: ignore[override]
        hoard = [bytes(2**28) for _ in range(64)]  # counted when it is asked for, not when it is filled
        raise InputError(f"{len(hoard)} times 256 MiB")


@pytest.mark.slow
def test_a_process_that_needs_too_much_memory_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[1])]))
    monkeypatch.setattr(Greedy, "__module__", "test_recording_process")
    monkeypatch.setitem(sys.modules, "test_recording_process", sys.modules[__name__])
    with refuses(InputError, 60, "run.csv"):
        Greedy(uploaded=True).read_confined(tmp_path / "run.csv", {"position": "m"}, {}, ONE.times)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("run.csv", f"t,{CANARY},speed,force\n0,1,2,3\n0.1,1,2,3\n"),
        ("run.csv", f"t,position,speed,force\n0,{CANARY},2,3\n0.1,1,2,3\n"),
        ("run.csv", f"{CANARY}\x1b]0;{CANARY}\x07\n{CANARY}\n"),
        ("run.npz", CANARY),
        *more(("run.mcap", CANARY), ("run.mat", f"MATLAB {CANARY}")),
    ],
)
def test_a_sentence_about_an_upload_has_nothing_of_the_file(name: str, content: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as refused:
        read(tmp_path / name)
    assert CANARY not in str(refused.value)
    assert "\x1b" not in str(refused.value)
    assert_names(str(refused.value), "position [m]", "speed [m/s]", "force [N]")


@pytest.mark.slow
def test_the_line_of_a_wrong_cell_of_an_upload_is_named(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text(f"t,position,speed,force\n0,1,2,3\n0.1,{CANARY},2,3\n0.2,1,2,3\n")
    with refuses(InputError, "run.csv", 3):
        read(tmp_path / "run.csv")
    with pytest.raises(InputError, match=CANARY):  # whoever names a file may know what is in it
        read(tmp_path / "run.csv", uploaded=False)
