"""Trials in SQLite: one file that survives the death of the process at any moment."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ctxval.describe import first_difference
from ctxval.errors import ForeignStoreError, InputError, StoreAccessError, StoreMismatchError
from ctxval.trajectory import Trajectory
from ctxval.trial import Origin, State, Trial

Side = Literal["model", "system"]

_APPLICATION = 0x63747876  # "ctxv" in SQLite's application_id: how a file says that it is one of ours

_MIGRATIONS = (
    (
        "trials, trajectories and the experiment's description",
        """
        CREATE TABLE migrations (version INTEGER PRIMARY KEY, title TEXT NOT NULL, applied_at TEXT NOT NULL);
        CREATE TABLE experiment (key TEXT PRIMARY KEY, value TEXT NOT NULL);
        CREATE TABLE trials (
            number INTEGER PRIMARY KEY,
            origin TEXT NOT NULL,
            state TEXT NOT NULL CHECK (state IN ('open', 'completed', 'failed')),
            unit_point TEXT NOT NULL,
            parameters TEXT NOT NULL,
            attempts INTEGER NOT NULL,
            distance REAL,
            failure TEXT,
            executed INTEGER NOT NULL DEFAULT 0,
            opened_at TEXT NOT NULL,
            closed_at TEXT,
            seconds REAL
        );
        CREATE TABLE trajectories (
            trial INTEGER NOT NULL REFERENCES trials (number),
            side TEXT NOT NULL CHECK (side IN ('model', 'system')),
            npz BLOB NOT NULL,
            PRIMARY KEY (trial, side)
        );
        """,
    ),
    ("what the search thought when it chose a trial", "ALTER TABLE trials ADD COLUMN note TEXT"),
    ("what was run, for commands that go on", "CREATE TABLE settings (key TEXT PRIMARY KEY, value TEXT NOT NULL)"),
)


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
        self.path = None if path is None else Path(path)
        self._name = "the store in memory" if self.path is None else str(self.path)
        with self._translating():
            if self.path is not None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
            self._connection = sqlite3.connect(self.path or ":memory:", isolation_level=None, timeout=10.0)
            self._prepare()

    @classmethod
    def existing(cls, path: str | Path) -> Store:
        """Open a store that must exist already.

        Raises:
            StoreAccessError: there is no such file.
        """
        if not Path(path).is_file():
            raise StoreAccessError(f"there is no store at {path}.")
        return cls(path)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    @contextmanager
    def sole_writer(self) -> Iterator[None]:
        """Keep other processes from running this store; the lock goes with the process, however it ends.

        Raises:
            StoreAccessError: another process is running it.
        """
        if self.path is None:
            yield
            return
        lock = sqlite3.connect(f"{self.path}.lock", isolation_level=None, timeout=0)
        try:
            try:
                lock.execute("BEGIN EXCLUSIVE")
            except sqlite3.OperationalError as error:
                raise StoreAccessError(f"{self._name} is being run by another process.") from error
            yield
        finally:
            lock.close()

    # The experiment

    def identify(self, description: dict[str, Any]) -> None:
        """Write which experiment the trials are of, or check that it is the stored one.

        Raises:
            StoreMismatchError: the store was made by another experiment; the message names the first difference.
        """
        stored = self.description()
        if not stored:
            with self._transaction():
                for key, value in description.items():
                    self._connection.execute("INSERT INTO experiment VALUES (?, ?)", (key, json.dumps(value)))
            return
        # Through JSON, so that tuples and keys compare as they were stored.
        difference = first_difference(stored, json.loads(json.dumps(description)))
        if difference:
            raise StoreMismatchError(f"{self._name} was made by another experiment: {difference}.")

    def description(self) -> dict[str, Any]:
        """Return the stored description of the experiment; empty in a new store."""
        with self._translating():
            rows = self._connection.execute("SELECT key, value FROM experiment ORDER BY rowid").fetchall()
        return {key: json.loads(value) for key, value in rows}

    def keep_settings(self, settings: dict[str, Any]) -> None:
        """Write how to make the experiment again, for commands that are given the store alone."""
        with self._transaction():
            self._connection.execute("DELETE FROM settings")
            for key, value in settings.items():
                self._connection.execute("INSERT INTO settings VALUES (?, ?)", (key, json.dumps(value)))

    def settings(self) -> dict[str, Any]:
        """Return how to make the experiment again; empty where it was not made by a command."""
        with self._translating():
            rows = self._connection.execute("SELECT key, value FROM settings ORDER BY rowid").fetchall()
        return {key: json.loads(value) for key, value in rows}

    # Trials

    def open_trial(self, trial: Trial, model_trajectory: Trajectory) -> None:
        """Store a new trial with its model trajectory, before its execution starts."""
        with self._transaction():
            self._connection.execute(
                "INSERT INTO trials (number, origin, state, unit_point, parameters, attempts, note, opened_at) "
                "VALUES (?, ?, 'open', ?, ?, ?, ?, ?)",
                (
                    trial.number,
                    trial.origin,
                    json.dumps(trial.unit_point.tolist()),
                    json.dumps(trial.parameters),
                    trial.attempts,
                    json.dumps(trial.note),
                    _now(),
                ),
            )
            self._write_trajectory(trial.number, "model", model_trajectory)

    def record_failed_plan(self, trial: Trial) -> None:
        """Store a new trial that failed before S was touched."""
        with self._transaction():
            self._connection.execute(
                "INSERT INTO trials (number, origin, state, unit_point, parameters, attempts, failure, note, "
                "opened_at, closed_at) VALUES (?, ?, 'failed', ?, ?, 0, ?, ?, ?, ?)",
                (
                    trial.number,
                    trial.origin,
                    json.dumps(trial.unit_point.tolist()),
                    json.dumps(trial.parameters),
                    trial.failure,
                    json.dumps(trial.note),
                    _now(),
                    _now(),
                ),
            )

    def begin_attempt(self, number: int) -> None:
        """Count one more start of a trial's execution, before it starts."""
        with self._transaction():
            self._connection.execute("UPDATE trials SET attempts = attempts + 1 WHERE number = ?", (number,))

    def close_trial(self, trial: Trial, system_trajectory: Trajectory | None) -> None:
        """Store how an open trial ended.

        Raises:
            InputError: the trial is not open.
        """
        with self._transaction():
            changed = self._connection.execute(
                "UPDATE trials SET state = ?, distance = ?, failure = ?, executed = ?, seconds = ?, closed_at = ? "
                "WHERE number = ? AND state = 'open'",
                (
                    trial.state,
                    trial.distance,
                    trial.failure,
                    trial.executed,
                    trial.seconds,
                    _now(),
                    trial.number,
                ),
            ).rowcount
            if changed != 1:
                raise InputError(f"trial {trial.number} is not open, so nothing can be told of it.")
            if system_trajectory is not None:
                self._write_trajectory(trial.number, "system", system_trajectory)

    def trials(self) -> list[Trial]:
        """Return all trials in their order."""
        with self._translating():
            rows = self._connection.execute(
                "SELECT number, origin, state, unit_point, parameters, attempts, executed, distance, failure, seconds, "
                "note FROM trials ORDER BY number"
            ).fetchall()
        return [_trial(*row) for row in rows]

    def trajectory(self, number: int, side: Side) -> Trajectory | None:
        """Return a stored trajectory of a trial; None if there is none."""
        with self._translating():
            row = self._connection.execute(
                "SELECT npz FROM trajectories WHERE trial = ? AND side = ?", (number, side)
            ).fetchone()
        return None if row is None else Trajectory.from_npz(row[0])

    def _write_trajectory(self, number: int, side: Side, trajectory: Trajectory) -> None:
        self._connection.execute("INSERT INTO trajectories VALUES (?, ?, ?)", (number, side, trajectory.to_npz()))

    # The file

    def _prepare(self) -> None:
        version = self._connection.execute("PRAGMA user_version").fetchone()[0]
        application = self._connection.execute("PRAGMA application_id").fetchone()[0]
        empty = self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        if not empty and application != _APPLICATION:
            raise ForeignStoreError(f"{self._name} is a database, but not a ctxval store.")
        if version > len(_MIGRATIONS):
            raise ForeignStoreError(
                f"{self._name} has schema version {version}, made by a newer ctxval; "
                f"this one reads up to {len(_MIGRATIONS)}."
            )
        self._connection.execute("PRAGMA synchronous = FULL")
        for number in range(version, len(_MIGRATIONS)):
            self._migrate(number)

    def _migrate(self, number: int) -> None:
        title, script = _MIGRATIONS[number]
        with self._transaction():
            if number == 0:
                self._connection.execute(f"PRAGMA application_id = {_APPLICATION}")
            for statement in script.split(";"):
                self._connection.execute(statement)
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
            raise ForeignStoreError(f"{self._name} cannot be read as a store: {error}.") from error
        except (OSError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise StoreAccessError(f"{self._name} cannot be used as a store: {error}.") from error


def _trial(number: int, origin: Origin, state: State, point: str, names: str, *rest: Any) -> Trial:
    attempts, executed, distance, failure, seconds, note = rest
    return Trial(
        *(number, origin, state, np.array(json.loads(point)), json.loads(names), attempts, bool(executed)),
        *(distance, failure, seconds, json.loads(note or "null")),
    )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
