"""Checks that a file has exactly the tables of a store, and a connection whose statements always end.

SQLite executes parts of a file: it runs views, triggers, generated columns and defaults, and replays a journal beside
the file. A store has only plain tables, so a file with anything else is refused before its content is used.
"""

from __future__ import annotations

import itertools
import os
import re
import sqlite3
from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ctxval._util.files import why_not_regular
from ctxval.errors import ForeignStoreError, StoreAccessError

APPLICATION = 0x63747876  # SQLite's application_id of a store, the letters "ctxv"; it marks a file as a store of ctxval

VERSION = 8  # SQLite's user_version of a store; it changes with :data:`TABLES`

TABLES = """
CREATE TABLE trials (
    number INTEGER PRIMARY KEY,
    origin TEXT NOT NULL,
    state TEXT NOT NULL,
    unit_point TEXT NOT NULL,
    parameters TEXT NOT NULL,
    attempts INTEGER NOT NULL,
    executed INTEGER NOT NULL,
    distance REAL,
    failure TEXT,
    seconds REAL,
    note TEXT,
    because TEXT,
    checksum INTEGER NOT NULL,
    opened_at TEXT NOT NULL,
    closed_at TEXT
);
CREATE TABLE trajectories (
    trial INTEGER NOT NULL REFERENCES trials (number),
    side TEXT NOT NULL,
    npz BLOB NOT NULL,
    checksum INTEGER NOT NULL,
    PRIMARY KEY (trial, side)
);
CREATE TABLE experiment (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE settings (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE history (
    number INTEGER PRIMARY KEY, at TEXT NOT NULL, what TEXT NOT NULL, why TEXT NOT NULL, content TEXT NOT NULL
);
CREATE TABLE computed (key TEXT PRIMARY KEY, digest TEXT NOT NULL, value TEXT NOT NULL);
"""
"""The statements that make the tables of a store, with which those of a file are compared."""

STEPS = 100_000_000  # largest number of SQLite instructions of one statement; reading a trial takes about twenty

_LIMITS = {
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: 100_000,
    sqlite3.SQLITE_LIMIT_COLUMN: 100,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 50,
    sqlite3.SQLITE_LIMIT_COMPOUND_SELECT: 5,
    sqlite3.SQLITE_LIMIT_FUNCTION_ARG: 8,
    sqlite3.SQLITE_LIMIT_ATTACHED: 0,
    sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH: 1,
}

_BESIDE = ("-journal", "-wal", "-shm")  # endings of the files beside a database that SQLite reads by itself


class Guarded(sqlite3.Connection):
    """A connection to an untrusted file, on which every statement ends after a bounded number of instructions."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        # The handler must not refer to the connection, which would never be freed.
        steps = self._steps = [0]

        def too_many() -> bool:
            steps[0] += 10_000
            return steps[0] > STEPS

        self.set_progress_handler(too_many, 10_000)
        for limit, value in _LIMITS.items():
            self.setlimit(limit, value)
        # Damaged bytes of a text must not prevent that other rows are read: the checksum of their row does not fit.
        self.text_factory = lambda text: text.decode("utf-8", "backslashreplace")
        self.execute("PRAGMA trusted_schema = OFF")
        self.execute("PRAGMA cell_size_check = ON")

    def execute(self, *statement: Any) -> sqlite3.Cursor:
        """Execute a statement; the bound allows reading millions of trials."""
        self._steps[0] = 0
        return super().execute(*statement)


def read_only(path: Path) -> sqlite3.Connection:
    """Open a file for reading as it is: no lock is taken, and no journal is replayed."""
    return sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True, factory=Guarded)


def require_files(path: Path) -> None:
    """Check that a store and the files that SQLite reads beside it are regular files, if they exist."""
    require_file(path)
    real = os.path.realpath(path)
    for ending in _BESIDE:
        with suppress(FileNotFoundError, NotADirectoryError):
            if reason := why_not_regular(os.lstat(real + ending).st_mode):
                what = f"{real}{ending} {reason.removeprefix('it ')}"
                raise StoreAccessError(f"{path} cannot be read as a store: {what}; move it away.")
    with suppress(OSError), open(f"{real}-journal", "rb") as file:
        file.seek(-8, os.SEEK_END)
        # The end of the journal of a transaction over several databases, which a store never makes.
        if file.read() == b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7":
            why = f"{real}-journal belongs to several databases; move it away"
            raise ForeignStoreError(f"{path} cannot be read as a store: {why}.")


def require_file(path: Path) -> None:
    """Check that a path is a regular file or does not exist."""
    try:
        reason = why_not_regular(os.stat(path).st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return
    except (OSError, ValueError) as error:
        reason = str(getattr(error, "strerror", None) or error)
    if reason:
        raise StoreAccessError(f"{path} cannot be read as a store: {reason}.")


def beside(path: Path) -> list[Path]:
    """Return the journals beside a database; another process left them or is writing them."""
    real = os.path.realpath(path)
    return [path for path in (Path(real + ending) for ending in _BESIDE) if path.is_file()]


def is_new(connection: sqlite3.Connection, name: str) -> bool:
    """Return whether a file is empty, after a check that it has exactly the tables of a store otherwise."""
    mark = connection.execute("PRAGMA application_id").fetchone()[0]
    version = int(connection.execute("PRAGMA user_version").fetchone()[0])
    if version == 0 and difference(connection, "") is None:
        return True
    if mark != APPLICATION:
        raise ForeignStoreError(f"{name} is a database, but not a ctxval store.")
    if version != VERSION:
        age = "a newer" if version > VERSION else "an older"
        raise ForeignStoreError(f"{name} has schema version {version} of {age} ctxval; this one reads only {VERSION}.")
    differs = difference(connection, TABLES)
    if differs is not None:
        raise ForeignStoreError(f"{name} is not a ctxval store: {differs}; `ctxval export` saves what is readable.")
    return False


def plain_tables(connection: sqlite3.Connection, names: Iterable[str]) -> dict[str, set[str]]:
    """Return the column names of each table that can be read row by row without running anything in the file."""
    wanted, plain = set(names), {}
    for kind, name, _, definition in itertools.islice(connection.execute(_MASTER), 100):
        ordinary = re.match(r"\s*create\s+table\b", str(definition), re.IGNORECASE)
        if kind != "table" or name not in wanted or not ordinary:
            continue
        rows = connection.execute(f"PRAGMA table_xinfo({name})").fetchall()
        columns = {str(row[1]).lower() for row in rows}
        if not any(row[-1] for row in rows) and not columns & {"rowid", "oid", "_rowid_"}:
            plain[str(name)] = columns
    return plain


def difference(connection: sqlite3.Connection, script: str) -> str | None:
    """Return how the tables of a file differ from those that a script makes; None if they agree."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as made:
        made.executescript(script)
        expected, present = _tables(made), _tables(connection)
    for kind, name in (key for key in present if key not in expected):
        return f"it has {'an' if str(kind)[:1] in 'aeiou' else 'a'} {kind} {name!r}"
    for key, what in expected.items():
        if present.get(key) != what:
            return f"its {key[0]} {key[1]!r} is {'missing' if key not in present else 'another one'}"
    return None


_MASTER = "SELECT type, name, tbl_name, sql FROM sqlite_master"


def _tables(connection: sqlite3.Connection) -> dict[tuple[str, str], tuple[str, str]]:
    # Versions of SQLite write definitions with different spaces and quotes.
    rows = itertools.islice(connection.execute(_MASTER), 100)
    return {(k, name): (table, re.sub(r'[\s"`\[\]]', "", str(made)).lower()) for k, name, table, made in rows}
