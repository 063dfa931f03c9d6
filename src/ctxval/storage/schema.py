"""Checks that a file has exactly the tables of a store, and a connection whose statements always end.

SQLite executes parts of a file: it runs views, triggers, generated columns and defaults, and replays a journal beside
the file. A store has only plain tables, so a file with anything else is refused before its content is used.
"""

from __future__ import annotations

import functools
import itertools
import os
import re
import sqlite3
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ctxval.errors import ForeignStoreError, StoreAccessError

_EVERY = 10_000
"""Instructions of SQLite between two checks of their number."""

STEPS = 100_000_000
"""Largest number of SQLite instructions of one statement; reading a trial takes about twenty."""

_OBJECTS = 100
"""Largest number of tables and indexes that are examined; a store has far fewer."""

_LIMITS = {
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: 100_000,
    sqlite3.SQLITE_LIMIT_COLUMN: 100,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 50,
    sqlite3.SQLITE_LIMIT_COMPOUND_SELECT: 5,
    sqlite3.SQLITE_LIMIT_FUNCTION_ARG: 8,
    sqlite3.SQLITE_LIMIT_ATTACHED: 0,
    sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH: 1,
}

_JOURNAL_MAGIC = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"

_BESIDE = ("-journal", "-wal", "-shm")
"""Endings of the files beside a database that SQLite reads by itself."""


class Guarded(sqlite3.Connection):
    """A connection to an untrusted file, on which every statement ends after a bounded number of instructions."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._steps = _Steps()
        self.set_progress_handler(self._steps.too_many, _EVERY)
        for limit, value in _LIMITS.items():
            self.setlimit(limit, value)
        self.execute("PRAGMA trusted_schema = OFF")
        self.execute("PRAGMA cell_size_check = ON")

    def execute(self, *statement: Any) -> sqlite3.Cursor:
        """Execute a statement; the bound allows reading millions of trials."""
        self._steps.taken = 0
        return super().execute(*statement)


class _Steps:
    """Counts instructions. It is separate from the connection, which would not be freed if it referred to itself."""

    def __init__(self) -> None:
        self.taken = 0

    def too_many(self) -> bool:
        self.taken += _EVERY
        return self.taken > STEPS


def require_files(path: Path) -> None:
    """Check that a store and the files that SQLite reads beside it are regular files, if they exist.

    Raises:
        StoreAccessError: if one of them is something else, such as a folder, a pipe or a device.
        ForeignStoreError: if the journal names another file, which SQLite would delete.
    """
    require_file(path)
    real = os.path.realpath(path)
    for ending in _BESIDE:
        beside = Path(real + ending)
        mode = _mode(beside, follow=False)
        if mode is not None and not stat.S_ISREG(mode):
            raise StoreAccessError(f"{path} cannot be read as a store: {beside} is {_kind(mode)}; move it away.")
    if _names_another(Path(f"{real}-journal")):
        raise ForeignStoreError(
            f"{path} cannot be read as a store: {real}-journal belongs to several databases; move it away."
        )


def require_file(path: Path) -> None:
    """Check that a path is a regular file or does not exist.

    Raises:
        StoreAccessError: if the path is something else, or cannot be examined.
    """
    try:
        mode = _mode(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise StoreAccessError(f"{path} cannot be read as a store: {reason}.") from error
    if mode is not None and not stat.S_ISREG(mode):
        raise StoreAccessError(f"{path} cannot be read as a store: it is {_kind(mode)}.")


def _mode(path: Path, *, follow: bool = True) -> int | None:
    try:
        return os.stat(path, follow_symlinks=follow).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFLNK: "a link",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    return kinds.get(stat.S_IFMT(mode), "not a file")


def _names_another(journal: Path) -> bool:
    """Return whether a journal belongs to a transaction over several databases, which a store never makes."""
    try:
        with journal.open("rb") as file:
            file.seek(-len(_JOURNAL_MAGIC), os.SEEK_END)
            return file.read() == _JOURNAL_MAGIC
    except OSError:
        return False


def beside(path: Path) -> list[Path]:
    """Return the journals beside a database; another process left them or is writing them."""
    real = os.path.realpath(path)
    return [found for ending in _BESIDE if (found := Path(real + ending)).is_file()]


@contextmanager
def snapshot(connection: sqlite3.Connection) -> Iterator[None]:
    """Make all reads inside see the file at one moment, whatever other processes write."""
    connection.execute("BEGIN")
    try:
        yield
    finally:
        if connection.in_transaction:
            connection.execute("ROLLBACK")


def version(connection: sqlite3.Connection, name: str, application: int, scripts: Sequence[str]) -> int:
    """Return the version of a file's tables, after a check that the file has exactly the tables of a store.

    Args:
        connection: the connection to the file.
        name: the name of the store in messages.
        application: the application_id of stores.
        scripts: the statements that bring a store from each version to the next; version 0 is an empty file.

    Raises:
        ForeignStoreError: if the file is not a store, or a store of a newer version.
    """
    mark = connection.execute("PRAGMA application_id").fetchone()[0]
    found = int(connection.execute("PRAGMA user_version").fetchone()[0])
    if mark == application and found > len(scripts):
        raise ForeignStoreError(
            f"{name} has schema version {found} of a newer ctxval; this version reads up to {len(scripts)}."
        )
    differs = difference(connection, tuple(scripts[: max(found, 0)]))
    if found == 0 and differs is None:
        return 0
    if mark != application:
        raise ForeignStoreError(f"{name} is a database, but not a ctxval store.")
    if differs is not None or found < 0:
        what = f"its schema version is {found}" if found < 0 else differs
        raise ForeignStoreError(f"{name} is not a ctxval store: {what}; `ctxval export` saves what is readable.")
    return found


def plain_tables(connection: sqlite3.Connection, names: Iterable[str]) -> dict[str, set[str]]:
    """Return the names of the columns of each table that can be read row by row without running anything in the file.

    Args:
        connection: the connection to the file.
        names: the names of the tables to look for.
    """
    wanted, found = set(names), {}
    for kind, name, _, definition in itertools.islice(connection.execute(_MASTER), _OBJECTS):
        if (
            kind != "table"
            or name not in wanted
            or not re.match(r"\s*create\s+table\b", str(definition), re.IGNORECASE)
        ):
            continue
        columns = connection.execute(f"PRAGMA table_xinfo({name})").fetchall()
        names_ = {str(column[1]).lower() for column in columns}
        if not any(column[-1] for column in columns) and not names_ & {"rowid", "oid", "_rowid_"}:
            found[str(name)] = names_
    return found


def difference(connection: sqlite3.Connection, scripts: tuple[str, ...]) -> str | None:
    """Return how the tables of a file differ from those that these scripts make. Returns None if they agree."""
    expected, found = _expected(scripts), {}
    for place, (kind, name, table, definition) in enumerate(connection.execute(_MASTER)):
        if place == _OBJECTS:
            return f"it has more than {_OBJECTS} tables"
        if (kind, name) not in expected:
            return f"it has {_article(kind)} {name!r}"
        found[kind, name] = (table, _bare(definition))
    for key, what in expected.items():
        if found.get(key) != what:
            return f"its {key[0]} {key[1]!r} is {'missing' if key not in found else 'another one'}"
    return None


_MASTER = "SELECT type, name, tbl_name, sql FROM sqlite_master"


def _article(kind: object) -> str:
    return f"{'an' if str(kind)[:1] in 'aeiou' else 'a'} {kind}"


@functools.cache
def _expected(scripts: tuple[str, ...]) -> dict[tuple[str, str], tuple[str, str]]:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    try:
        for script in scripts:
            connection.executescript(script)
        rows = connection.execute(_MASTER).fetchall()
    finally:
        connection.close()
    return {(kind, name): (table, _bare(definition)) for kind, name, table, definition in rows}


def _bare(definition: object) -> str:
    """Return a definition without spaces and quotes, which versions of SQLite write differently."""
    return re.sub(r'[\s"`\[\]]', "", str(definition)).lower()
