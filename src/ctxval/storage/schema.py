"""Whether a file is laid out as a store, before anything in it is believed; and a connection that comes to an end.

SQLite takes orders from a file: views, triggers, generated columns and defaults are run, and a journal beside it is
played back. A store has nothing but plain tables, so that whatever else is in a file makes it none.
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
"""Instructions of SQLite between two looks at how many there were."""

STEPS = 100_000_000
"""Instructions of SQLite that one statement may take: reading a trial takes about twenty."""

_OBJECTS = 100
"""Tables and indexes beyond which nobody needs to look any further."""

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
"""Files that SQLite reads beside a database, without being asked."""


class Guarded(sqlite3.Connection):
    """A connection to a file that anybody may have made: none of its statements goes on for ever."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._steps = _Steps()
        self.set_progress_handler(self._steps.too_many, _EVERY)
        for limit, value in _LIMITS.items():
            self.setlimit(limit, value)
        self.execute("PRAGMA trusted_schema = OFF")
        self.execute("PRAGMA cell_size_check = ON")

    def execute(self, *statement: Any) -> sqlite3.Cursor:
        """Execute a statement, which may take as long as reading millions of trials."""
        self._steps.taken = 0
        return super().execute(*statement)


class _Steps:
    """Counts instructions; apart from the connection, which would never be freed if it held itself."""

    def __init__(self) -> None:
        self.taken = 0

    def too_many(self) -> bool:
        self.taken += _EVERY
        return self.taken > STEPS


def require_files(path: Path) -> None:
    """Check that a store, if there is one, and what SQLite reads beside it are files, and that they touch no others.

    Raises:
        StoreAccessError: there is something else, such as a folder, a pipe or a device.
        ForeignStoreError: its journal names another file, which SQLite would delete.
    """
    require_file(path)
    real = os.path.realpath(path)
    for ending in _BESIDE:
        beside = Path(real + ending)
        mode = _mode(beside, follow=False)
        if mode is not None and not stat.S_ISREG(mode):
            raise StoreAccessError(f"{path} cannot be read as a store: {beside} is {_kind(mode)}; move it away.")
    if _names_another(Path(f"{real}-journal")):
        raise ForeignStoreError(f"{path} cannot be read as a store: {real}-journal is of several files; move it away.")


def require_file(path: Path) -> None:
    """Check that a path is a file or nothing.

    Raises:
        StoreAccessError: it is something else, or nobody can say.
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
    return kinds.get(stat.S_IFMT(mode), "no file")


def _names_another(journal: Path) -> bool:
    """Return whether a journal is of a transaction over several files; one of a store never is."""
    try:
        with journal.open("rb") as file:
            file.seek(-len(_JOURNAL_MAGIC), os.SEEK_END)
            return file.read() == _JOURNAL_MAGIC
    except OSError:
        return False


def beside(path: Path) -> list[Path]:
    """Return the journals of a database that another process left."""
    real = os.path.realpath(path)
    return [found for ending in _BESIDE if (found := Path(real + ending)).is_file()]


@contextmanager
def snapshot(connection: sqlite3.Connection) -> Iterator[None]:
    """Read at one moment, whatever other processes write meanwhile."""
    connection.execute("BEGIN")
    try:
        yield
    finally:
        if connection.in_transaction:
            connection.execute("ROLLBACK")


def version(connection: sqlite3.Connection, name: str, application: int, scripts: Sequence[str]) -> int:
    """Return the version of a file's tables, after a check that they are those of a store and nothing else is there.

    Args:
        connection: to the file.
        name: of the store.
        application: the mark of our files.
        scripts: that bring a store from each version to the next; version 0 is an empty file.

    Raises:
        ForeignStoreError: it is no store, or one of a newer version.
    """
    mark = connection.execute("PRAGMA application_id").fetchone()[0]
    found = int(connection.execute("PRAGMA user_version").fetchone()[0])
    if mark == application and found > len(scripts):
        raise ForeignStoreError(
            f"{name} has schema version {found}, made by a newer ctxval; this one reads up to {len(scripts)}."
        )
    differs = difference(connection, tuple(scripts[: max(found, 0)]))
    if found == 0 and differs is None:
        return 0
    if mark != application:
        raise ForeignStoreError(f"{name} is a database, but not a ctxval store.")
    if differs is not None or found < 0:
        what = f"its schema version is {found}" if found < 0 else differs
        raise ForeignStoreError(f"{name} is no ctxval store: {what}; `ctxval export` saves what is readable.")
    return found


def plain_tables(connection: sqlite3.Connection, names: Iterable[str]) -> dict[str, set[str]]:
    """Return those of these tables that can be read row by row without running anything, with their columns."""
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
    """Return how the tables of a file differ from those that these scripts make; None if they do not."""
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
    """Return a definition without what versions of SQLite write differently: spaces and quotes."""
    return re.sub(r'[\s"`\[\]]', "", str(definition)).lower()
