"""A power cut takes nothing that was acknowledged: some hundreds of the disks that it could leave, opened again."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from crash.disk import SECTOR, Disk, Mode  # noqa: E402
from crash.recorder import Event  # noqa: E402
from crash_states import count, recorded  # noqa: E402
from ctxval.campaign.storage import disks  # noqa: E402
from rig_thorough import more  # noqa: E402

needs_strace = pytest.mark.skipif(shutil.which("strace") is None, reason="writes are recorded with strace")


def told(mode: Mode, *events: Event) -> Disk:
    disk = Disk(mode)
    for event in events:
        disk.tell(event)
    return disk


def left(disk: Disk, tries: int = 300) -> set[tuple[tuple[str, bytes], ...]]:
    rng = np.random.default_rng(0)
    return {tuple(disk.cut(rng).items()) for _ in range(tries)}


# The model of a disk


def test_what_is_synced_stays_and_what_is_not_may_go() -> None:
    disk = told("ordered", Event("create", "a"), Event("write", "a", 0, b"one"), Event("sync", "a"))
    assert left(disk) == {(("a", b"one"),)}
    disk.tell(Event("write", "a", 0, b"two"))
    found = left(disk)
    assert {(("a", b"one"),), (("a", b"two"),)} <= found
    assert all(len(dict(files)["a"]) == 3 for files in found)


def test_writes_are_torn_at_sectors_and_lost_in_any_order() -> None:
    old, new = b"o" * 4 * SECTOR, b"n" * SECTOR
    disk = told("ordered", Event("create", "a"), Event("write", "a", 0, old), Event("sync", "a"))
    disk.tell(Event("write", "a", 0, new * 4))
    found = {dict(files)["a"] for files in left(disk, 3000)}
    assert new + old[SECTOR:] in found
    assert old[:SECTOR] + new + old[2 * SECTOR :] in found
    disk.tell(Event("write", "a", 0, b"later"))
    assert new * 4 in {dict(files)["a"] for files in left(disk)}


def test_a_removed_file_may_come_back_until_its_folder_is_synced() -> None:
    disk = told("ordered", Event("create", "a"), Event("sync", "a"), Event("unlink", "a"))
    assert left(disk) == {(), (("a", b""),)}
    disk.tell(Event("sync folder", ""))
    assert left(disk) == {()}


def test_posix_promises_less_of_a_new_file_than_journalling_file_systems_do() -> None:
    made = (Event("mkdir", "runs"), Event("create", "runs/a"), Event("sync", "runs/a"))
    assert left(told("ordered", *made)) == {(("runs/a", b""),)}
    assert () in left(told("strict", *made))
    assert () in left(told("strict", *made, Event("sync folder", "runs")))
    assert left(told("strict", *made, Event("sync folder", "runs"), Event("sync folder", ""))) == {(("runs/a", b""),)}


def test_a_renamed_file_has_one_of_its_names() -> None:
    disk = told("ordered", Event("create", "a"), Event("sync", "a"), Event("rename", "a", target="b"))
    assert {(("a", b""),), (("b", b""),)} <= left(disk)
    assert () not in left(disk)


# Campaigns


@pytest.mark.thorough
@pytest.mark.slow
@needs_strace
@pytest.mark.parametrize(
    ("name", "mode", "every"), [("hand", "ordered", 4), *more(("hand", "ordered", 1), ("full", "strict", 1))]
)
def test_no_acknowledged_execution_is_lost_or_doubled(name: str, mode: Mode, every: int, tmp_path: Path) -> None:
    counts = count(recorded(name, tmp_path), mode, each=1, seed=0, resume_each=100 // every, workers=1, every=every)
    assert counts["distinct"] > 200 / every
    assert counts["resumed"] > 1
    assert counts["opened"] == counts["distinct"]
    assert counts["went on"] == counts["resumed"]
    assert not any(counts[bad] for bad in ("lost", "twice", "changed", "refused", "crashed"))


@pytest.mark.slow
@pytest.mark.thorough
@needs_strace
def test_a_journal_that_comes_back_takes_an_execution_with_it(tmp_path: Path) -> None:
    """With SQLite's own default, which shows that the check can see a loss."""
    recording = recorded("run", tmp_path, "FULL")
    assert count(recording, "ordered", each=1, seed=0, resume_each=10**6, workers=1)["lost"] > 0


def test_a_new_folder_is_synced_into_the_one_that_it_is_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(disks, "sync_folder", synced.append)
    disks.make_folder(tmp_path / "runs" / "today")
    disks.make_folder(tmp_path / "runs" / "today")
    assert synced == [tmp_path / "runs", tmp_path]


@pytest.mark.skipif(os.name == "nt", reason="folders cannot be synced there")
def test_a_folder_that_cannot_be_opened_is_left_as_it_is(tmp_path: Path) -> None:
    disks.sync_folder(tmp_path)
    disks.sync_folder(tmp_path / "none")
