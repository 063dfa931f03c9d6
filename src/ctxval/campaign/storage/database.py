"""The SQLite file under a store: opening it, one transaction for each change, locks, and errors in one sentence."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ctxval._util.files import LOCKS_FILE_ITSELF, FileLock, LockedError
from ctxval._util.progress import advance, stage
from ctxval.campaign.storage import schema
from ctxval.campaign.storage.disks import make_folder, network, warn_of_network
from ctxval.errors import ForeignStoreError, InputError, StoreAccessError


class Database:
    """A SQLite file with the tables of a store; opening a new one makes them.

    Attributes:
        path: the absolute path of the file; None if the tables are in memory.
        name: the name of the store in messages.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        # Absolute, because an executed system may change the current folder of the process.
        self.path = None if path is None else Path(path).absolute()
        self.name = "the store in memory" if path is None else str(path)
        self._lock: FileLock | None = None
        self._locked = False
        with self.translated_errors():
            if self.path is not None:
                make_folder(self.path.parent)
                warn_of_network(self.path)
                schema.require_files(self.path)
            self._connection = sqlite3.connect(
                self.path or ":memory:", isolation_level=None, timeout=10.0, factory=schema.Guarded
            )
            try:
                self._prepare()
            except BaseException:
                self._connection.close()
                raise

    def close(self) -> None:
        """Close the file."""
        self._connection.close()
        if self._lock is not None:
            self._lock.close()

    def execute(self, statement: str, values: tuple[Any, ...] = ()) -> sqlite3.Cursor:
        """Execute one statement. Call this inside :meth:`transaction` or :meth:`translated_errors`."""
        return self._connection.execute(statement, values)

    @contextmanager
    def rows(self, statement: str) -> Iterator[sqlite3.Cursor]:
        """Read rows one by one, because a damaged file may yield rows without end."""
        with self.translated_errors(), closing(self._connection.execute(statement)) as cursor:
            yield cursor

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """Make all reads inside see the file at one moment. Keep them short: other processes wait to write."""
        with self.translated_errors():
            if self._connection.in_transaction:
                yield
                return
            self._connection.execute("BEGIN")
            try:
                yield
            finally:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")

    @contextmanager
    def sole_writer(self, wait: float = 0.0) -> Iterator[None]:
        """Prevent other processes from running this store; the lock ends with the process, however that ends."""
        if self.path is None or self._locked:
            yield
            return
        lock = self._acquired(self.path, wait)
        self._locked = True
        try:
            yield
        finally:
            self._locked = False
            lock.release()

    def _acquired(self, path: Path, wait: float) -> FileLock:
        until = time.monotonic() + wait
        try:
            real = path.resolve()
            itself = LOCKS_FILE_ITSELF and not network(real)
            lock = self._lock = self._lock or FileLock(real if itself else real.with_name(f"{real.name}.lock"))
            with suppress(LockedError):
                lock.acquire()
                return lock
            with stage("waiting for another process that is running the store", wait, "s"):
                while True:
                    try:
                        lock.acquire()
                        return lock
                    except LockedError:
                        if time.monotonic() >= until:
                            raise
                    time.sleep(0.02)
                    advance(0.02)
        except LockedError as error:
            raise StoreAccessError(f"{self.name} is being run by another process.") from error
        except OSError as error:
            raise StoreAccessError(f"{self.name} cannot be locked: {error.strerror or error}.") from error

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Execute the statements inside as one transaction, which is on the disk at its end."""
        with self.translated_errors():
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")

    @contextmanager
    def translated_errors(self) -> Iterator[None]:
        """Turn errors of SQLite and of the file into exceptions of ctxval that name the store."""
        try:
            yield
        except sqlite3.IntegrityError as error:
            raise StoreAccessError(f"{self.name} was written by another process at the same time: {error}.") from error
        except sqlite3.OperationalError as error:
            raise StoreAccessError(f"{self.name} cannot be used as a store: {error}.") from error
        except sqlite3.DatabaseError as error:
            hint = "; `ctxval export` saves what is readable" if "malformed" in str(error) else ""
            raise ForeignStoreError(f"{self.name} cannot be read as a store: {error}{hint}.") from error
        except OSError as error:
            where = "" if error.filename is None else f"{error.filename}: "
            raise StoreAccessError(
                f"{self.name} cannot be used as a store: {where}{error.strerror or error}."
            ) from error
        except (ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise StoreAccessError(f"{self.name} cannot be used as a store: {error}.") from error

    def damaged(self, what: str) -> ForeignStoreError:
        """Return the error that part of the store cannot be read; ``what`` says which part."""
        return ForeignStoreError(f"{self.name} is damaged: {what}; `ctxval export` saves what is readable.")

    def _prepare(self) -> None:
        with self.snapshot():
            new = schema.is_new(self._connection, self.name)
            page = self._connection.execute("PRAGMA page_size").fetchone()[0]
            if self.path is not None and self.path.stat().st_size % page:
                raise self.damaged("its end is missing")
        if self._connection.execute("PRAGMA journal_mode").fetchone()[0] == "wal":
            # A store is one file.
            self._connection.execute("PRAGMA journal_mode = DELETE")
        # FULL does not sync the folder after a journal is removed: a power cut may bring the journal back, and SQLite
        # then undoes the last transaction.
        self._connection.execute("PRAGMA synchronous = EXTRA")
        if new:
            with self.transaction():
                if not schema.is_new(self._connection, self.name):
                    return  # another process has made them
                self._connection.execute(f"PRAGMA application_id = {schema.APPLICATION}")
                for statement in schema.TABLES.split(";"):
                    self._connection.execute(statement)
                self._connection.execute(f"PRAGMA user_version = {schema.VERSION}")


def now() -> str:
    """Return the present time in UTC, in the format of stores."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
