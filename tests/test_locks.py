from __future__ import annotations

import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from ctxval.locks import lock

TRY = "import sys; from ctxval.locks import lock; lock(sys.argv[1])"


def taken_elsewhere(path: Path) -> bool:
    """Return whether another process can take the lock."""
    return subprocess.run([sys.executable, "-c", TRY, str(path)], capture_output=True).returncode == 0


def test_a_lock_is_held_until_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = lock(path)
    assert not taken_elsewhere(path)
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        lock(path)
    held.close()
    assert taken_elsewhere(path)
    lock(path).close()


def test_a_failed_attempt_takes_nothing_from_the_holder(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = lock(path)
    for _ in range(3):
        with pytest.raises(sqlite3.OperationalError):
            lock(path)
    assert not taken_elsewhere(path)
    held.close()


def test_where_no_file_can_be_there_is_no_lock(tmp_path: Path) -> None:
    with pytest.raises(sqlite3.DatabaseError):
        lock(tmp_path / "missing" / "lock")
