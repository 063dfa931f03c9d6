"""Trials in SQLite: one file that survives the death of the process at any moment."""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from ctxval._util.locks import LOCKS_FILE_ITSELF, FileLock, LockedError
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Change, Trial
from ctxval.errors import ForeignStoreError, InputError, StoreAccessError, StoreMismatchError
from ctxval.storage import rows, schema
from ctxval.storage.disks import make_folder, on_network, warn_of_network
from ctxval.storage.migrations import MIGRATIONS
from ctxval.storage.rows import (
    COLUMNS,
    ENDED,
    checksum_of,
    ended_row,
    read_trajectory,
    read_trial,
    real,
    row_of,
    trial_checksum,
)

Side = Literal["model", "system"]

_APPLICATION = 0x63747876  # "ctxv" in SQLite's application_id: how a file says that it is one of ours

_DRAWS = "draws"
"""Key of the table experiment that is no part of the description."""

_WAIT = 0.02
"""Seconds between two attempts to become the sole writer."""


class Store:
    """A file of trials, of one experiment.

    Every change is one transaction, on the disk before the call returns.

    Args:
        path: the file; made if it does not exist. None keeps the trials in memory.

    Raises:
        StoreAccessError: the file cannot be opened or written.
        ForeignStoreError: the file is no store, or one of a newer version.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        # Absolute, as what is executed may change the folder of the process.
        self.path = None if path is None else Path(path).absolute()
        self._name = "the store in memory" if path is None else str(path)
        self._lock: FileLock | None = None
        self._locked = False
        with self._translating():
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

    @classmethod
    def existing(cls, path: str | Path) -> Store:
        """Open a store that must exist already.

        Raises:
            StoreAccessError: there is no such file, or it is none that can be read.
        """
        schema.require_files(Path(path))
        if not os.path.exists(path):
            raise StoreAccessError(f"there is no store at {path}.")
        if not os.access(path, os.R_OK):
            raise StoreAccessError(f"{path} cannot be read as a store: it is not readable for you.")
        if not os.path.getsize(path):
            raise ForeignStoreError(f"{path} is an empty file, not a store.")
        return cls(path)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()
        if self._lock is not None:
            self._lock.close()

    @contextmanager
    def sole_writer(self, wait: float = 0.0) -> Iterator[None]:
        """Keep other processes from running this store; the lock goes with the process, however it ends.

        Args:
            wait: seconds to wait for another process that is about to end.

        Raises:
            StoreAccessError: another process is running it.
        """
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
            lock = self._lock = self._lock or FileLock(_lockable(path))
            while True:
                try:
                    lock.acquire()
                    return lock
                except LockedError:
                    if time.monotonic() >= until:
                        raise
                time.sleep(_WAIT)
        except LockedError as error:
            raise StoreAccessError(f"{self._name} is being run by another process.") from error
        except OSError as error:
            raise StoreAccessError(f"{self._name} cannot be locked: {error.strerror or error}.") from error

    # The experiment

    def describe_first(self, description: dict[str, Any]) -> dict[str, Any]:
        """Write which experiment the trials are of, unless that is written already; return what is stored."""
        with self._transaction():
            if not self.description():
                self._write_description(description)
        return self.description()

    def describe_anew(self, description: dict[str, Any], change: Change) -> None:
        """Replace which experiment the trials are of, and keep in the history what has changed and why."""
        with self._transaction():
            self._write_description(description)
            self._insert_change(change)

    def _write_description(self, description: dict[str, Any]) -> None:
        self._connection.execute("DELETE FROM experiment WHERE key != ?", (_DRAWS,))
        for key, value in description.items():
            self._connection.execute("INSERT INTO experiment VALUES (?, ?)", (key, json.dumps(value)))

    def description(self) -> dict[str, Any]:
        """Return the stored description of the experiment; empty in a new store."""
        return {key: value for key, value in self._pairs("experiment").items() if key != _DRAWS}

    def draws(self) -> int | None:
        """Return what the randomness of independent draws depends on besides the seed; None if nothing is stored."""
        kept = self._pairs("experiment").get(_DRAWS)
        return kept if isinstance(kept, int) else None

    def keep_draws(self, number: int) -> None:
        """Write what the randomness of independent draws depends on, once and for all."""
        with self._transaction():
            self._connection.execute("INSERT OR IGNORE INTO experiment VALUES (?, ?)", (_DRAWS, json.dumps(number)))

    @property
    def name(self) -> str:
        """What the store is called in messages."""
        return self._name

    def keep_settings(self, settings: dict[str, Any]) -> None:
        """Write how to make the experiment again, for commands that are given the store alone."""
        if self.settings() == json.loads(json.dumps(settings)):
            return
        with self._transaction():
            self._connection.execute("DELETE FROM settings")
            for key, value in settings.items():
                self._connection.execute("INSERT INTO settings VALUES (?, ?)", (key, json.dumps(value)))

    def settings(self) -> dict[str, Any]:
        """Return how to make the experiment again; empty where it was not made by a command."""
        return self._pairs("settings")

    def _pairs(self, table: str) -> dict[str, Any]:
        with self._rows(f"SELECT key, value FROM {table} ORDER BY rowid") as found:
            try:
                return rows.read_pairs(found)
            except InputError as error:
                raise self._damaged(f"the {table} in it cannot be read") from error

    @contextmanager
    def _rows(self, statement: str) -> Iterator[sqlite3.Cursor]:
        """Read rows one by one, as in a damaged file there may be no end of them."""
        with self._translating(), closing(self._connection.execute(statement)) as cursor:
            yield cursor

    # The history

    def history(self) -> list[Change]:
        """Return what was changed in the store after it was written, and why, in order."""
        with self._rows("SELECT what, why, content, at FROM history ORDER BY number") as found:
            try:
                return [Change(str(what), str(why), rows.read_json(told), str(at)) for what, why, told, at in found]
            except InputError as error:
                raise self._damaged("its history cannot be read") from error

    def _insert_change(self, change: Change) -> None:
        self._connection.execute(
            "INSERT INTO history (at, what, why, content) VALUES (?, ?, ?, ?)",
            (_now(), change.what, change.why, json.dumps(change.content)),
        )

    def remeasure(
        self, trials: Sequence[Trial], description: dict[str, Any], change: Change, seen: tuple[int, int, int]
    ) -> bool:
        """Store trials whose distances were computed anew, with the description of the distance, in one piece.

        What they were stays in the history.

        Returns:
            False if the store is not as :meth:`signature` was when the trials were read; nothing is stored then.
        """
        with self._transaction():
            if self.signature() != seen:
                return False
            for trial in trials:
                self._connection.execute(
                    f"UPDATE trials SET {ENDED}, checksum = ? WHERE number = ?",
                    (*ended_row(trial), trial_checksum(row_of(trial)), trial.number),
                )
            self._write_description(description)
            self._insert_change(change)
        return True

    def _require_unchanged(self, changes: int | None) -> None:
        """Refuse what a campaign would write that has not seen a change of the experiment.

        Raises:
            StoreMismatchError: the store has other changes than the campaign has seen.
        """
        if changes is not None and self.signature()[2] != changes:
            raise StoreMismatchError(
                f"{self._name} was changed meanwhile, by remeasure or by a change that was accepted; open the campaign "
                "again, with the experiment as it is now."
            )

    # Trials

    def open_trial(self, trial: Trial, model_trajectory: Trajectory, *, changes: int | None = None) -> None:
        """Store a new trial with its model trajectory, before its execution starts."""
        with self._transaction():
            self._require_unchanged(changes)
            self._insert(trial)
            self._write_trajectory(trial.number, "model", model_trajectory)

    def record_failed_plan(self, trial: Trial, *, changes: int | None = None) -> None:
        """Store a new trial that failed before S was touched."""
        with self._transaction():
            self._require_unchanged(changes)
            self._insert(trial)

    def record_known(
        self,
        trial: Trial,
        model_trajectory: Trajectory,
        system_trajectory: Trajectory | None,
        *,
        changes: int | None = None,
    ) -> None:
        """Store a new trial that has ended already, in one piece."""
        with self._transaction():
            self._require_unchanged(changes)
            self._insert(trial)
            self._write_trajectory(trial.number, "model", model_trajectory)
            if system_trajectory is not None:
                self._write_trajectory(trial.number, "system", system_trajectory)

    def _insert(self, trial: Trial) -> None:
        row = row_of(trial)
        closed_at = None if trial.state == "open" else _now()
        places = ", ".join("?" * (len(row) + 3))
        self._connection.execute(
            f"INSERT INTO trials ({COLUMNS}, checksum, opened_at, closed_at) VALUES ({places})",
            (*row, trial_checksum(row), _now(), closed_at),
        )

    def begin_attempt(self, trial: Trial, *, changes: int | None = None) -> None:
        """Count one more start of a trial's execution, before it starts; the trial is as it will be then.

        Raises:
            InputError: the trial is not open any more.
        """
        with self._transaction():
            self._require_unchanged(changes)
            changed = self._connection.execute(
                "UPDATE trials SET attempts = ?, checksum = ? WHERE number = ? AND state = 'open'",
                (trial.attempts, trial_checksum(row_of(trial)), trial.number),
            ).rowcount
            if changed != 1:
                raise self._not_open(trial.number)

    def close_trial(self, trial: Trial, system_trajectory: Trajectory | None, *, changes: int | None = None) -> None:
        """Store how an open trial ended.

        Raises:
            InputError: the trial is not open; of two that tell, the first one wins.
        """
        with self._transaction():
            self._require_unchanged(changes)
            changed = self._connection.execute(
                f"UPDATE trials SET {ENDED}, seconds = ?, closed_at = ?, checksum = ? "
                "WHERE number = ? AND state = 'open' AND attempts = ?",
                (
                    *(*ended_row(trial), real(trial.seconds), _now(), trial_checksum(row_of(trial))),
                    *(trial.number, trial.attempts),
                ),
            ).rowcount
            if changed != 1:
                raise self._not_open(trial.number)
            if system_trajectory is not None:
                self._write_trajectory(trial.number, "system", system_trajectory)

    def _not_open(self, number: int) -> InputError:
        row = self._connection.execute("SELECT state FROM trials WHERE number = ?", (number,)).fetchone()
        state = "not open" if row is None else "being executed by another process" if row[0] == "open" else row[0]
        return InputError(f"trial {number} is {state}, so nothing more can be told of it.")

    def trials(self) -> list[Trial]:
        """Return all trials in their order.

        Raises:
            ForeignStoreError: one of them is damaged.
        """
        found: list[Trial] = []
        with self._rows(f"SELECT {COLUMNS}, checksum FROM trials ORDER BY number") as cursor:
            for *row, checksum in cursor:
                trial = read_trial(tuple(row), checksum)
                if trial is None or not rows.follows(trial, found):
                    raise self._damaged(f"its trial {len(found)} cannot be read")
                found.append(trial)
        return found

    def signature(self) -> tuple[int, int, int]:
        """Return how many trials, open trials and changes there are: what another process may have changed."""
        with self._translating():
            row = self._connection.execute(
                "SELECT count(*), coalesce(sum(state = 'open'), 0), (SELECT count(*) FROM history) FROM trials"
            ).fetchone()
        return int(row[0]), int(row[1]), int(row[2])

    def _damaged(self, what: str) -> ForeignStoreError:
        return ForeignStoreError(f"{self._name} is damaged: {what}; `ctxval export` saves what is readable.")

    def trajectory(self, number: int, side: Side) -> Trajectory | None:
        """Return a stored trajectory of a trial; None if there is none.

        Raises:
            ForeignStoreError: it is damaged.
        """
        where = "FROM trajectories {} WHERE trial = ? AND side = ?"
        with self._translating():
            row = self._connection.execute(f"SELECT npz, checksum {where.format('')}", (number, side)).fetchone()
            # A damaged index may hide a row; without it, finding none takes longer.
            hidden = (
                row is None
                and self._connection.execute(f"SELECT 1 {where.format('NOT INDEXED')}", (number, side)).fetchone()
            )
        if row is None and not hidden:
            return None
        found = None if row is None else read_trajectory(number, side, *row)
        if found is None:
            raise self._damaged(f"the {side}'s trajectory of its trial {number} cannot be read")
        return found

    def _write_trajectory(self, number: int, side: Side, trajectory: Trajectory) -> None:
        npz = trajectory.to_npz()
        self._connection.execute(
            "INSERT INTO trajectories (trial, side, npz, checksum) VALUES (?, ?, ?, ?)",
            (number, side, npz, checksum_of((number, side, npz))),
        )

    # The file

    def _prepare(self) -> None:
        with schema.snapshot(self._connection):
            version = schema.version(self._connection, self._name, _APPLICATION, [sql for _, sql in MIGRATIONS])
            page = self._connection.execute("PRAGMA page_size").fetchone()[0]
            if self.path is not None and self.path.stat().st_size % page:
                raise self._damaged("its end is missing")
        if self._connection.execute("PRAGMA journal_mode").fetchone()[0] == "wal":
            # A store is one file.
            self._connection.execute("PRAGMA journal_mode = DELETE")
        # FULL does not sync the folder after a journal is removed: a power cut may bring the journal back, and SQLite
        # then takes back the last transaction.
        self._connection.execute("PRAGMA synchronous = EXTRA")
        for number in range(version, len(MIGRATIONS)):
            self._migrate(number)

    def _migrate(self, number: int) -> None:
        title, script = MIGRATIONS[number]
        with self._transaction():
            if self._connection.execute("PRAGMA user_version").fetchone()[0] > number:
                return  # another process was faster
            if number == 0:
                self._connection.execute(f"PRAGMA application_id = {_APPLICATION}")
            for statement in script.split(";"):
                self._connection.execute(statement)
            if number + 1 == rows.CHECKED:
                rows.write_checksums(self._connection)
            self._connection.execute("INSERT INTO migrations VALUES (?, ?, ?)", (number + 1, title, _now()))
            self._connection.execute(f"PRAGMA user_version = {number + 1}")

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._translating():
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")

    @contextmanager
    def _translating(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.IntegrityError as error:
            raise StoreAccessError(f"{self._name} was written by another process meanwhile: {error}.") from error
        except sqlite3.OperationalError as error:
            raise StoreAccessError(f"{self._name} cannot be used as a store: {error}.") from error
        except sqlite3.DatabaseError as error:
            hint = "; `ctxval export` saves what is readable" if "malformed" in str(error) else ""
            raise ForeignStoreError(f"{self._name} cannot be read as a store: {error}{hint}.") from error
        except (OSError, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise StoreAccessError(f"{self._name} cannot be used as a store: {error}.") from error


def _lockable(path: Path) -> Path:
    """Return what is locked for a store: the file itself by its real name, or a file beside it where that cannot be."""
    real = path.resolve()
    itself = LOCKS_FILE_ITSELF and not on_network(real)
    return real if itself else real.with_name(f"{real.name}.lock")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
