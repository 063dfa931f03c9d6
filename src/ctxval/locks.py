"""A lock that goes with its process, however that ends: SQLite's on a file, which all operating systems have."""

from __future__ import annotations

import sqlite3
from pathlib import Path


def lock(path: str | Path) -> sqlite3.Connection:
    """Return the lock on a file, which is made if need be; it is held until it is closed or the process ends.

    Raises:
        sqlite3.DatabaseError: it is held, by this process or another ("locked"), or there can be none on this disk.
    """
    held = sqlite3.connect(path, isolation_level=None, timeout=0, check_same_thread=False)
    try:
        held.execute("BEGIN EXCLUSIVE")
    except sqlite3.DatabaseError:
        held.close()
        raise
    return held
