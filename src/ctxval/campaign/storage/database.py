"""The SQLite file under a store: opening it, one transaction for each change, locks, and errors in one sentence."""

from __future__ import annotations

import shlex
import sqlite3
import time
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from ctxval._util.files import LOCKS_FILE_ITSELF, FileLock, LockedError
from ctxval._util.progress import advance, stage
from ctxval.campaign.storage import schema
from ctxval.campaign.storage.disks import StoreWarning, make_folder, network
from ctxval.errors import CtxvalError, ForeignStoreError, StoreAccessError


class Database:
    """A SQLite file with the tables of a store, made if it is new; its path is absolute, None in memory."""

    def __init__(self, path: str | Path | None = None) -> None:
        self.name = "the store in memory" if path is None else str(path)
        self._lock: FileLock | None = None
        self._locked = False
        with self._translated_errors():
            # Absolute, because an executed system may change the current folder of the process.
            self.path = None if path is None else Path(path).absolute()
            if self.path is not None:
                make_folder(self.path.parent)
                if kind := network(self.path):
                    warnings.warn(
                        f"{self.path} is on a network file system ({kind}), whose locks and flushes are not reliable; "
                        "keep the store on a disk of this computer.",
                        StoreWarning,
                        stacklevel=3,
                    )
                schema.require_files(self.path)
            file = self.path or ":memory:"
            self._connection = sqlite3.connect(file, isolation_level=None, timeout=10.0, factory=schema.Guarded)
            self._execute = self._connection.execute
            try:
                self._prepare()
            except BaseException:
                self._connection.close()
                raise

    def _prepare(self) -> None:
        with self.snapshot():
            new = schema.is_new(self._connection, self.name)
            page = self._execute("PRAGMA page_size").fetchone()[0]
            if self.path is not None and self.path.stat().st_size % page:
                raise self._damaged("its end is missing")
        if self._execute("PRAGMA journal_mode").fetchone()[0] == "wal":
            self._execute("PRAGMA journal_mode = DELETE")  # a store is one file
        # FULL does not sync the folder after a journal is removed: a power cut may bring the journal back, and SQLite
        # then undoes the last transaction.
        self._execute("PRAGMA synchronous = EXTRA")
        if new:
            with self._transaction():
                if not schema.is_new(self._connection, self.name):
                    return  # another process has made them
                self._execute(f"PRAGMA application_id = {schema.APPLICATION}")
                for statement in schema.TABLES.split(";"):
                    self._execute(statement)
                self._execute(f"PRAGMA user_version = {schema.VERSION}")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()
        if self._lock is not None:
            self._lock.close()

    @contextmanager
    def sole_writer(self, wait: float = 0.0) -> Iterator[None]:
        """Prevent other processes from running this store; wait so many seconds for one that is running it."""
        if self.path is None or self._locked:
            yield
            return
        try:
            if self._lock is None:
                real = self.path.resolve()
                itself = LOCKS_FILE_ITSELF and not network(real)
                self._lock = FileLock(real if itself else real.with_name(f"{real.name}.lock"))
            _acquire(self._lock, wait)
        except LockedError as error:
            raise StoreAccessError(f"{self.name} is being run by another process.") from error
        except OSError as error:
            raise StoreAccessError(f"{self.name} cannot be locked: {error.strerror or error}.") from error
        self._locked = True
        try:
            yield
        finally:
            self._locked = False
            self._lock.release()

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """Make all reads inside see the file at one moment. Keep them short: other processes wait to write."""
        with self._translated_errors():
            if self._connection.in_transaction:
                yield
                return
            self._execute("BEGIN")
            try:
                yield
            finally:
                if self._connection.in_transaction:
                    self._execute("ROLLBACK")

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Execute the statements inside as one transaction, which is on the disk at its end."""
        with self._translated_errors():
            self._execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._connection.in_transaction:
                    self._execute("ROLLBACK")
                raise
            self._execute("COMMIT")

    @contextmanager
    def _rows(self, statement: str) -> Iterator[sqlite3.Cursor]:
        """Read rows one by one, because a damaged file may yield rows without end."""
        with self._translated_errors(), closing(self._execute(statement)) as cursor:
            yield cursor

    @contextmanager
    def _translated_errors(self) -> Iterator[None]:
        """Turn errors of SQLite and of the file into exceptions of ctxval that name the store."""
        try:
            yield
        except CtxvalError:
            raise
        except sqlite3.IntegrityError as error:
            raise StoreAccessError(f"{self.name} was written by another process at the same time: {error}.") from error
        except sqlite3.DatabaseError as error:
            if isinstance(error, sqlite3.OperationalError):
                raise StoreAccessError(f"{self.name} cannot be used as a store: {error}.") from error
            hint = "; `ctxval export` saves what is readable" if "malformed" in str(error) else ""
            raise ForeignStoreError(f"{self.name} cannot be read as a store: {error}{hint}.") from error
        except (OSError, ValueError, OverflowError) as error:
            file, reason = getattr(error, "filename", None), getattr(error, "strerror", None) or error
            where = "" if file is None else f"{file}: "
            raise StoreAccessError(f"{self.name} cannot be used as a store: {where}{reason}.") from error

    def _damaged(self, what: str) -> ForeignStoreError:
        return ForeignStoreError(f"{self.name} is damaged: {what}; `ctxval export` saves what is readable.")

    def _unreadable(self, number: int, what: str) -> ForeignStoreError:
        store = shlex.quote(self.name)
        advice = f"`ctxval status {store} --set-aside {number}` sets this trial aside, so that the others are usable"
        return ForeignStoreError(
            f"{self.name} is damaged: {what}; {advice}, and `ctxval export` saves what is readable."
        )


def _acquire(lock: FileLock, wait: float) -> None:
    with suppress(LockedError):
        return lock.acquire()
    with stage("waiting for another process that is running the store", wait, "s"):
        for _ in range(round(wait / 0.02)):
            time.sleep(0.02)
            advance(0.02)
            with suppress(LockedError):
                return lock.acquire()
    return lock.acquire()


def now() -> str:
    """Return the present time in UTC, in the format of stores."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
