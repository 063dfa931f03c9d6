"""Search for other stores of the same experiment beside a store.

A verdict that is chosen among several stores is wrong more often than one verdict.
"""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ctxval._util.describe import first_difference
from ctxval.storage import schema
from ctxval.storage.rows import MOST_CHARACTERS

STORE_SUFFIXES = (".sqlite", ".sqlite3", ".db")
"""Suffixes of files that are taken for stores."""
_MOST_FILES = 500
"""Largest number of files in a folder that are checked."""

_HEADER = 72
"""Bytes at the start of a SQLite file; the last four of them are its application_id."""

_MARK = b"ctxv"

_UNREADABLE = (sqlite3.Error, OSError, ValueError, TypeError, OverflowError, MemoryError, RecursionError)


def other_stores(path: Path) -> list[Path]:
    """Return the other stores in a store's folder with trials of the same validation and model, of any search and seed.

    Nothing is built, run or written. Files that cannot be read are skipped.
    """
    try:
        own = _validation_of(path)
        beside = sorted(one for one in path.absolute().parent.iterdir() if one.suffix in STORE_SUFFIXES)[:_MOST_FILES]
    except _UNREADABLE:
        return []
    return [path.with_name(one.name) for one in beside if one.name != path.name and _is_of(one, own)]


def _is_of(path: Path, own: dict[str, Any]) -> bool:
    try:
        return path.is_file() and first_difference(own, _validation_of(path)) is None
    except _UNREADABLE:
        return False


def _validation_of(path: Path) -> dict[str, Any]:
    """Return a store's description of its validation, and the number that depends on its model."""
    with path.open("rb") as file:
        header = file.read(_HEADER)
    if not header.startswith(b"SQLite format 3\0") or header[-4:] != _MARK:
        raise ValueError(f"{path} is not a store")
    uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"  # takes no lock and replays no journal
    with closing(sqlite3.connect(uri, uri=True, factory=schema.Guarded)) as connection:
        if not {"key", "value", "executed"} <= _columns(connection):
            raise ValueError(f"{path} is not a store")
        rows = connection.execute(
            "SELECT key, value FROM experiment WHERE key IN ('validation', 'draws') AND length(value) <= ?",
            (MOST_CHARACTERS,),
        ).fetchall()
        executed = connection.execute("SELECT EXISTS (SELECT 1 FROM trials WHERE executed)").fetchone()[0]
    found = {str(key): json.loads(value) for key, value in rows}
    if not isinstance(found.get("validation"), dict) or not executed:
        raise ValueError(f"{path} has no executed trials of an experiment")
    return found


def _columns(connection: sqlite3.Connection) -> set[str]:
    found = schema.plain_tables(connection, ("experiment", "trials"))
    return set().union(*found.values()) if len(found) == 2 else set()
