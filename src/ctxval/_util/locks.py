"""File locks that are released when their process ends, however it ends.

The lock is exclusive, whatever path the file is opened by, and a forked process does not inherit it. ``filelock`` does
not serve here: it closes the file at each release, which releases this process's own locks of a database in use.
"""

from __future__ import annotations

import os
import sqlite3
import sys
import weakref
from pathlib import Path

LOCKS_FILE_ITSELF = sys.platform == "linux"
"""Whether a file can be locked while SQLite uses it. On Linux ``flock`` does not interfere with the locks of SQLite."""


class LockedError(OSError):
    """The lock is held already, by this process or another one."""


if sys.platform == "linux":
    import fcntl

    class FileLock:
        """The lock of a file, which is created if it does not exist."""

        def __init__(self, path: str | Path) -> None:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            self.close = weakref.finalize(self, os.close, self._file)  # which releases the lock
            _open.add(self)

        def acquire(self) -> None:
            """Take the lock; it is held until it is released or the process ends."""
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise LockedError("the lock is held") from None

        def release(self) -> None:
            """Release the lock. The file stays open: closing it would release this process's SQLite locks of it."""
            fcntl.flock(self._file, fcntl.LOCK_UN)

    _open: weakref.WeakSet[FileLock] = weakref.WeakSet()
    os.register_at_fork(after_in_child=lambda: [lock.close() for lock in list(_open)])
else:

    class FileLock:
        """The lock of a file that has no other use: a transaction of SQLite."""

        def __init__(self, path: str | Path) -> None:
            try:
                self._connection = sqlite3.connect(path, isolation_level=None, timeout=0, check_same_thread=False)
            except sqlite3.DatabaseError as error:
                raise OSError(str(error)) from error
            self.close = self._connection.close

        def acquire(self) -> None:
            try:
                self._connection.execute("BEGIN EXCLUSIVE")
            except sqlite3.DatabaseError as error:
                raise LockedError("the lock is held") if "locked" in str(error) else OSError(str(error)) from error

        def release(self) -> None:
            self._connection.execute("ROLLBACK")
