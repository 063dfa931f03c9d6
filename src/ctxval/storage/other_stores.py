"""Other stores of the same experiment beside one: a verdict that is chosen among several is wrong more often."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ctxval._util.describe import first_difference
from ctxval.storage import schema

_SUFFIXES = (".sqlite", ".sqlite3", ".db")
_MOST_FILES = 500
"""Files of a folder that are looked at."""

_HEADER = 72
"""Bytes of a SQLite file up to its application's mark, which is the last of them."""

_MARK = b"ctxv"

_LONGEST = 2**24
"""Characters of a description that are read."""

_UNREADABLE = (sqlite3.Error, OSError, ValueError, TypeError, OverflowError, MemoryError, RecursionError)


def other_stores(path: Path) -> list[Path]:
    """Return the other stores in the folder of one with trials of the same validation, by whatever search and seed.

    Nothing is built, run or written; a file that cannot be read is passed over.
    """
    try:
        own = _validation_of(path)
        beside = sorted(one for one in path.absolute().parent.iterdir() if one.suffix in _SUFFIXES)[:_MOST_FILES]
    except _UNREADABLE:
        return []
    return [path.with_name(one.name) for one in beside if one.name != path.name and _is_of(one, own)]


def _is_of(path: Path, own: dict[str, Any]) -> bool:
    try:
        return path.is_file() and first_difference(own, _validation_of(path)) is None
    except _UNREADABLE:
        return False


def _validation_of(path: Path) -> dict[str, Any]:
    """Return what a store says of its validation.

    Raises:
        ValueError: it says nothing of it, or has no trial that was executed.
        sqlite3.Error, OSError: it cannot be read.
    """
    with path.open("rb") as file:
        header = file.read(_HEADER)
    if not header.startswith(b"SQLite format 3\0") or header[-4:] != _MARK:
        raise ValueError(f"{path} is no store")
    uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"  # no lock is taken and no journal played back
    with closing(sqlite3.connect(uri, uri=True, factory=schema.Guarded)) as connection:
        if not {"key", "value", "executed"} <= _columns(connection):
            raise ValueError(f"{path} is no store")
        row = connection.execute(
            "SELECT value FROM experiment WHERE key = 'validation' AND length(value) <= ?", (_LONGEST,)
        ).fetchone()
        executed = connection.execute("SELECT EXISTS (SELECT 1 FROM trials WHERE executed)").fetchone()[0]
    if row is None or not executed:
        raise ValueError(f"{path} has no trials of an experiment")
    found = json.loads(row[0])
    if not isinstance(found, dict):
        raise ValueError(f"{path} does not describe its validation")
    return found


def _columns(connection: sqlite3.Connection) -> set[str]:
    found = schema.plain_tables(connection, ("experiment", "trials"))
    return set().union(*found.values()) if len(found) == 2 else set()
