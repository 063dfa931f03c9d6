from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from ctxval._util.files import LOCKS_FILE_ITSELF, FileLock, LockedError

TRY = "import sys; from ctxval._util.files import FileLock; FileLock(sys.argv[1]).acquire()"


def taken_elsewhere(path: Path) -> bool:
    """Return whether another process can take the lock."""
    return subprocess.run([sys.executable, "-c", TRY, str(path)], capture_output=True).returncode == 0


@pytest.mark.slow
def test_a_lock_is_held_until_it_is_released(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = FileLock(path)
    held.acquire()
    assert not taken_elsewhere(path)
    with pytest.raises(LockedError):
        FileLock(path).acquire()
    held.release()
    assert taken_elsewhere(path)
    held.acquire()
    assert not taken_elsewhere(path)
    held.close()
    assert taken_elsewhere(path)


def test_a_failed_attempt_takes_nothing_from_the_holder(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = FileLock(path)
    held.acquire()
    for _ in range(3):
        with pytest.raises(LockedError):
            FileLock(path).acquire()
    assert not taken_elsewhere(path)
    held.close()


def test_where_no_file_can_be_there_is_no_lock(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"No such file|unable to open"):
        FileLock(tmp_path / "missing" / "lock").acquire()


@pytest.mark.skipif(not LOCKS_FILE_ITSELF, reason="here a database in use cannot be locked itself")
def test_a_database_is_locked_by_any_of_its_names_and_stays_usable(tmp_path: Path) -> None:
    path, link = tmp_path / "a.sqlite", tmp_path / "b.sqlite"
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("CREATE TABLE t (x)")
    link.symlink_to(path)
    held = FileLock(path)
    held.acquire()
    assert not taken_elsewhere(link)
    connection.execute("INSERT INTO t VALUES (1)")
    connection.execute("BEGIN IMMEDIATE")
    held.release()
    writing = "import sqlite3, sys; sqlite3.connect(sys.argv[1], timeout=0).execute('INSERT INTO t VALUES (2)')"
    refused = subprocess.run([sys.executable, "-c", writing, str(path)], capture_output=True, text=True)
    assert "locked" in refused.stderr  # releasing our lock has not released SQLite's
    connection.execute("COMMIT")
    held.close()
    connection.close()


@pytest.mark.slow
@pytest.mark.skipif(not LOCKS_FILE_ITSELF, reason="locks of SQLite are not inherited anyway")
def test_a_forked_process_neither_holds_nor_releases_the_lock(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = FileLock(path)
    held.acquire()
    ready, go = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(ready, 1)
        os._exit(0)
    try:
        assert not taken_elsewhere(path)
        held.close()
        assert taken_elsewhere(path)  # while the child lives
    finally:
        os.write(go, b"x")
        os.waitpid(child, 0)
        os.close(ready)
        os.close(go)
