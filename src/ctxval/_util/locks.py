"""File locks that are released when their process ends, however it ends."""

from __future__ import annotations

import os
import sqlite3
import sys
import weakref
from pathlib import Path

if sys.platform == "linux":
    import fcntl

LOCKS_FILE_ITSELF = sys.platform == "linux"
"""Whether a file can be locked while SQLite uses it. On Linux ``flock`` does not interfere with the locks of SQLite."""


class LockedError(OSError):
    """The lock is held already, by this process or another one."""


class FileLock:
    """The exclusive lock of a file, whatever path the file is opened by; a forked process does not inherit the lock.

    On Linux the file may be a database in use. On other systems the lock is a transaction of SQLite, so the file must
    have no other use.

    Args:
        path: the file; it is created if it does not exist.
    """

    def __init__(self, path: str | Path) -> None:
        self._lock: _Flock | _Transaction = _Flock(path) if LOCKS_FILE_ITSELF else _Transaction(path)

    def acquire(self) -> None:
        """Take the lock; it is held until it is released or the process ends."""
        self._lock.acquire()

    def release(self) -> None:
        """Release the lock. The file stays open: closing it would release this process's SQLite locks of the file."""
        self._lock.release()

    def close(self) -> None:
        """Close the file, which releases the lock."""
        self._lock.close()


_open: weakref.WeakSet[_Flock] = weakref.WeakSet()


def _close_inherited() -> None:
    for lock in list(_open):
        lock.close()


if sys.platform == "linux":
    os.register_at_fork(after_in_child=_close_inherited)


class _Flock:
    def __init__(self, path: str | Path) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        self.close = weakref.finalize(self, os.close, self._file)
        _open.add(self)

    def acquire(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LockedError("the lock is held") from None

    def release(self) -> None:
        fcntl.flock(self._file, fcntl.LOCK_UN)


class _Transaction:
    def __init__(self, path: str | Path) -> None:
        try:
            self._connection = sqlite3.connect(path, isolation_level=None, timeout=0, check_same_thread=False)
        except sqlite3.DatabaseError as error:
            raise OSError(str(error)) from error

    def acquire(self) -> None:
        try:
            self._connection.execute("BEGIN EXCLUSIVE")
        except sqlite3.DatabaseError as error:
            raise LockedError("the lock is held") if "locked" in str(error) else OSError(str(error)) from error

    def release(self) -> None:
        self._connection.execute("ROLLBACK")

    def close(self) -> None:
        self._connection.close()
