"""Trials in a SQLite file, which stays intact if the process dies at any moment."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ctxval._util.checked import PositiveFloat, checked, require
from ctxval._util.representation import Shown, call
from ctxval._util.texts import text_of
from ctxval._util.version import VERSION
from ctxval.campaign.storage import rows, schema
from ctxval.campaign.storage.database import Database, now
from ctxval.campaign.storage.rows import COLUMNS, Side, checksum_of, read_trajectory, read_trial, row_of
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import REDEFINED, Change, StatedThreshold, Trial
from ctxval.errors import CtxvalError, ForeignStoreError, InputError, StoreAccessError, StoreMismatchError

_DRAWS, _THRESHOLDS = "draws", "thresholds"  # keys in the table experiment that do not describe the experiment

CAUSE = "cause"  #: key of what is computed of the cause of a model's error: a text, for reports


@checked
class Store(Database):
    """A file with the trials of one experiment.

    Every change is one transaction, which is on the disk before the call returns. Methods with the argument ``changes``
    raise a :class:`StoreMismatchError` if the store has another number of changes; None skips this check.

    Args:
        path: the file; it is created if it does not exist. None keeps the trials in memory.

    Raises:
        StoreAccessError: if the file cannot be opened or written.
        ForeignStoreError: if the file is not a store, or a store of another version.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        super().__init__(path)
        # The system's trajectories are read for each choice of a task: they stay in memory, None if there is none, with
        # their checksums, which show what another connection has changed.
        self._kept: dict[int, tuple[int | None, Trajectory | None]] = {}
        self._memory = 512 * 2**20  # bytes that are left for them
        self._version: int | None = None  # of the file when they were read

    @classmethod
    def existing(cls, path: str | Path) -> Store:
        """Open a store that must exist already; otherwise, and for other files, as the constructor raises.

        Raises:
            StoreAccessError: if there is no file, or if it may not be read.
            ForeignStoreError: if it is no store.
        """
        schema.require_files(Path(path))
        if not os.path.exists(path):
            raise StoreAccessError(f"there is no store at {path}.")
        if not os.access(path, os.R_OK):
            raise StoreAccessError(f"{path} cannot be read as a store: you do not have permission to read it.")
        if not os.path.getsize(path):
            raise ForeignStoreError(f"{path} is an empty file, not a store.")
        return cls(path)

    # The experiment

    def describe_first(self, description: dict[str, Any]) -> dict[str, Any]:
        """Store the description of the experiment if there is none yet; return the stored description."""
        with self._transaction():
            if not self.description():
                self._write_description(description)
                self._insert_pairs("experiment", {_THRESHOLDS: []})
            return self.description()

    def describe_anew(self, description: dict[str, Any], change: Change) -> None:
        """Replace the description of the experiment, and record in the history what has changed and why."""
        with self._transaction():
            self._write_description(description)
            self._insert_change(change)

    def _write_description(self, description: dict[str, Any]) -> None:
        self._execute("DELETE FROM experiment WHERE key NOT IN (?, ?)", (_DRAWS, _THRESHOLDS))
        self._insert_pairs("experiment", description)

    def description(self) -> dict[str, Any]:
        """Return the stored description of the experiment; empty in a new store."""
        pairs = self._pairs("experiment").items()
        return {key: value for key, value in pairs if key not in (_DRAWS, _THRESHOLDS)}

    def draws(self) -> int | None:
        """Return the number that seeds independent draws together with the seed; None if none is stored."""
        number = self._pairs("experiment").get(_DRAWS)
        return number if isinstance(number, int) else None

    def keep_draws(self, number: int) -> None:
        """Store the number that seeds independent draws; a number that is stored already stays."""
        with self._transaction():
            self._execute("INSERT OR IGNORE INTO experiment VALUES (?, ?)", (_DRAWS, json.dumps(number)))

    def thresholds(self) -> tuple[StatedThreshold, ...] | None:
        """Return the thresholds in the order in which they were first stated; None if the store does not keep them.

        Those that were stated for another definition of the distance are left out.
        """
        stated = self._pairs("experiment").get(_THRESHOLDS)
        if stated is None:
            return None
        thresholds = list[StatedThreshold]()
        for each in stated if isinstance(stated, list) else [None]:
            match each:
                case {"threshold": float(threshold), "distances": int(known), "at": str(at)} if (
                    0 < threshold < math.inf
                ):
                    thresholds.append(StatedThreshold(threshold, known, at))
                case _:
                    raise self._damaged("its thresholds cannot be read")
        return tuple(thresholds)

    def state_threshold(self, threshold: float) -> None:
        """Record a threshold with the number of distances that are known; if it is recorded already, nothing changes.

        A store without thresholds is one that no campaign has described, and stays as it is.
        """
        require("threshold", PositiveFloat, threshold)
        if any(each.threshold == threshold for each in self.thresholds() or ()):
            return
        with self._transaction():
            stated = self.thresholds()
            if stated is not None and all(each.threshold != threshold for each in stated):
                known = self._execute("SELECT count(*) FROM trials WHERE state = 'completed'").fetchone()[0]
                stated = (*stated, StatedThreshold(float(threshold), int(known), now()))
                key, text = rows.pair_of(_THRESHOLDS, [asdict(each) for each in stated])
                self._execute("UPDATE experiment SET value = ? WHERE key = ?", (text, key))

    def keep_settings(self, settings: dict[str, Any]) -> None:
        """Store the settings that make the experiment again, for commands that get only the store."""
        if self.settings() != json.loads(rows.as_json(settings)):
            with self._transaction():
                self._execute("DELETE FROM settings")
                self._insert_pairs("settings", settings)

    def settings(self) -> dict[str, Any]:
        """Return the settings that make the experiment again; empty if no command made the store."""
        return self._pairs("settings")

    def _insert_pairs(self, table: str, pairs: dict[str, Any]) -> None:
        for pair in pairs.items():
            self._execute(f"INSERT INTO {table} VALUES (?, ?)", rows.pair_of(*pair))

    def _pairs(self, table: str) -> dict[str, Any]:
        bounded = (f"CASE WHEN length({cell}) <= {rows.MOST_CHARACTERS} THEN {cell} END" for cell in ("key", "value"))
        pairs: dict[str, Any] = {}
        with self._rows(f"SELECT {', '.join(bounded)} FROM {table} ORDER BY rowid") as content:
            try:
                for key, value in content:
                    if not isinstance(key, str) or key in pairs:
                        raise InputError(f"a key must be a text that occurs once, got {key!r}.")
                    pairs[key] = rows.read_json(value, finite=False)
            except InputError as error:
                raise self._damaged(f"the {table} in it cannot be read") from error
        return pairs

    # The history

    def history(self) -> list[Change]:
        """Return the later changes of the store in order, each with its reason."""
        with self._rows("SELECT what, why, content, at FROM history ORDER BY number") as changes:
            try:
                return [
                    Change(str(what), str(why), rows.read_json(text, finite=False), str(at))
                    for what, why, text, at in changes
                ]
            except InputError as error:
                raise self._damaged("its history cannot be read") from error

    def _insert_change(self, change: Change) -> None:
        statement = "INSERT INTO history (at, what, why, content) VALUES (?, ?, ?, ?)"
        self._execute(statement, (now(), *map(text_of, (change.what, change.why)), rows.as_json(change.content)))

    def remeasure(
        self, trials: Sequence[Trial], description: dict[str, Any], change: Change, seen: tuple[int, int, int]
    ) -> bool:
        """Store trials with new distances, and the description of the new distance, in one transaction.

        Returns False, and stores nothing, if the :meth:`signature` of the store is not the one that was seen when the
        trials were read. The change, for the history, has the previous distances.
        """
        with self._transaction():
            if self.signature() != seen:
                return False
            for trial in trials:
                self._update(trial)
            self._write_description(description)
            self._insert_change(change)
            if change.why == REDEFINED:
                # They were thresholds of another distance.
                self._execute("UPDATE experiment SET value = '[]' WHERE key = ?", (_THRESHOLDS,))
        return True

    def _require_unchanged(self, changes: int | None) -> None:
        if changes is not None and self.signature()[2] != changes:
            raise StoreMismatchError(
                f"{self.name} has changed since the campaign was opened, by remeasure or by accept_change; open the "
                "campaign again with the present experiment."
            )

    # Trials

    def add(
        self, new: Iterable[tuple[Trial, Trajectory | None, Trajectory | None]], *, changes: int | None = None
    ) -> None:
        """Store new trials with their trajectories of model and system, None if there is none, in one transaction."""
        with self._transaction():
            self._require_unchanged(changes)
            for trial, model_trajectory, system_trajectory in new:
                row = row_of(trial)
                values = (*row, checksum_of(row), now(), None if trial.state == "open" else now())
                places = ", ".join("?" * len(values))
                columns = f"{COLUMNS}, checksum, opened_at, closed_at"
                self._execute(f"INSERT INTO trials ({columns}) VALUES ({places})", values)
                self._read_back(row)
                self._write_trajectory(trial.number, "model", model_trajectory)
                self._write_trajectory(trial.number, "system", system_trajectory)

    def begin_attempt(self, trial: Trial, *, changes: int | None = None) -> None:
        """Record one more attempt, which the trial counts, before the execution starts."""
        with self._transaction():
            self._require_unchanged(changes)
            self._update(trial, "AND state = 'open'")

    def close_trials(self, ended: Iterable[tuple[Trial, Trajectory | None]], *, changes: int | None = None) -> None:
        """Store the results of open trials with their trajectories of the system in one transaction: all, or none.

        Of two results for one trial, the first is stored.
        """
        with self._transaction():
            self._require_unchanged(changes)
            for trial, system_trajectory in ended:
                self._update(trial, f"AND state = 'open' AND attempts = {trial.attempts:d}", closed_at=now())
                self._write_trajectory(trial.number, "system", system_trajectory)

    def replace_result(
        self, before: Trial, after: Trial, trajectory: Trajectory | None, why: str, *, changes: int | None = None
    ) -> None:
        """Replace the result of a trial; the history keeps the earlier one, with its trajectory as NPZ in base 64."""
        executed = self.trajectory(before.number, "system")
        npz = None if executed is None else base64.b64encode(executed.to_npz()).decode()
        result = {"state": before.state, "distance": before.distance, "failure": before.failure, "npz": npz}
        with self._transaction():
            self._require_unchanged(changes)
            self._update(after, closed_at=now())
            self._execute("DELETE FROM trajectories WHERE trial = ? AND side = 'system'", (after.number,))
            self._write_trajectory(after.number, "system", trajectory)
            self._insert_change(Change("replaced", why, {"before": {str(before.number): result}}))

    def _update(self, trial: Trial, where: str = "", closed_at: str | None = None) -> None:
        """Store what an execution changes in a trial, which must satisfy a further condition."""
        columns = ("attempts", "state", "distance", "failure", "executed", "seconds", "note")
        whole = row_of(trial)
        row = dict(zip(COLUMNS.split(", "), whole, strict=True))
        values = (*(row[name] for name in columns), checksum_of(whole), closed_at, trial.number)
        assignments = f"{' = ?, '.join(columns)} = ?, checksum = ?, closed_at = coalesce(?, closed_at)"
        if self._execute(f"UPDATE trials SET {assignments} WHERE number = ? {where}", values).rowcount != 1:
            row = self._execute("SELECT state FROM trials WHERE number = ?", (trial.number,)).fetchone()
            state = "not open" if row is None else "being executed by another process" if row[0] == "open" else row[0]
            raise InputError(f"trial {trial.number} is {state}, so nothing more can be told of it.")
        self._read_back(whole)

    def _read_back(self, row: tuple[Any, ...]) -> None:
        """Check, before the transaction is committed, that SQLite returns a trial as it was written."""
        read = self._execute(f"SELECT {COLUMNS} FROM trials WHERE number = ?", row[:1]).fetchone()
        if repr(read) != repr(row):
            raise InputError(f"trial {row[0]} is not stored: another task, or other values, would be read back.")

    def trials(self) -> list[Trial]:
        """Return all trials in their order. Raises a :class:`ForeignStoreError` if one is damaged."""
        trials: list[Trial] = []
        with self._rows(f"SELECT {COLUMNS}, checksum FROM trials ORDER BY number") as cursor:
            for *row, checksum in cursor:
                try:
                    trial = read_trial(tuple(row), checksum)
                except InputError as error:
                    raise self._unreadable(
                        len(trials), f"its trial {len(trials)} cannot be read, because {error}"
                    ) from error
                if not rows.follows(trial, trials):
                    raise self._damaged(f"its trial {len(trials)} is missing, or is that of another task space")
                trials.append(trial)
        return trials

    def signature(self) -> tuple[int, int, int]:
        """Return the numbers of trials, of open trials and of changes, to notice what another process has changed."""
        with self._translated_errors():
            row = self._execute(
                "SELECT count(*), coalesce(sum(state = 'open'), 0), (SELECT count(*) FROM history) FROM trials"
            ).fetchone()
        return int(row[0]), int(row[1]), int(row[2])

    # What was computed

    def digest(self) -> str:
        """Return a digest of all that results follow from: trials, trajectories, the experiment, and this version."""
        digest = hashlib.sha256(VERSION.encode())
        with self.snapshot():
            for query in (
                f"SELECT key, value FROM experiment WHERE key != '{_THRESHOLDS}' ORDER BY key",
                "SELECT number, checksum FROM trials ORDER BY number",
                "SELECT trial, side, checksum FROM trajectories ORDER BY trial, side",
                "SELECT number, what, why, content FROM history ORDER BY number",
            ):
                with self._rows(query) as content:
                    for row in content:
                        digest.update(repr(row).encode())
        return digest.hexdigest()

    def computed(self, key: str) -> Any:
        """Return what was computed from the present content and kept under a key; None if nothing was."""
        query = f"SELECT value, digest FROM computed WHERE key = ? AND length(value) <= {rows.MOST_CHARACTERS}"
        with self._translated_errors():
            row = self._execute(query, (key,)).fetchone()
        try:
            return rows.read_json(row[0], finite=False) if row is not None and row[1] == self.digest() else None
        except InputError:
            return None  # it can be computed again

    def keep_computed(self, key: str, value: Any, digest: str) -> None:
        """Keep what was computed from the content with a digest, and forget what other content gave."""
        with self._transaction():
            self._execute("DELETE FROM computed WHERE digest != ?", (digest,))
            key, text = rows.pair_of(key, value)
            self._execute("INSERT OR REPLACE INTO computed VALUES (?, ?, ?)", (key, digest, text))

    # Trajectories

    def trajectory(self, number: int, side: Side) -> Trajectory | None:
        """Return a stored trajectory of a trial, whose arrays may be changed; None if there is none."""
        trajectory = self.trajectories([number], side).get(number)
        # Some distances change the arrays that they are given.
        return None if trajectory is None else trajectory.copy()

    def trajectories(self, numbers: Iterable[int], side: Side) -> dict[int, Trajectory]:
        """Return stored trajectories by the numbers of their trials; a trial without one is left out.

        Those of the system are kept in memory, up to 512 MiB, so that they are read once. Their arrays are read-only.
        A damaged trajectory is a :class:`ForeignStoreError`.
        """
        if side == "model":
            known = {number: self._read_trajectory(number, side)[1] for number in numbers}
            return {number: trajectory for number, trajectory in known.items() if trajectory is not None}
        with self.snapshot():
            version = self._execute("PRAGMA data_version").fetchone()[0]
            if version != self._version:  # another connection has changed the file
                self._version = version
                statement = "SELECT trial, checksum FROM trajectories WHERE side = 'system'"
                stored = dict(self._execute(statement)) if self._kept else {}
                for number in [each for each, (checksum, _) in self._kept.items() if stored.get(each) != checksum]:
                    self._memory += _size(self._kept.pop(number)[1])
        executed = dict[int, Trajectory]()
        for number in numbers:
            checksum, trajectory = self._kept.get(number) or self._read_trajectory(number, side)
            # To drop an older one would not help: all are read in turn.
            if number not in self._kept and _size(trajectory) <= self._memory:
                self._memory -= _size(trajectory)
                self._kept[number] = checksum, trajectory
                for array in () if trajectory is None else (trajectory.times, trajectory.states, trajectory.inputs):
                    array.setflags(write=False)
            if trajectory is not None:
                executed[number] = trajectory
        return executed

    def _read_trajectory(self, number: int, side: Side) -> tuple[int | None, Trajectory | None]:
        where = "FROM trajectories {} WHERE trial = ? AND side = ?"
        with self.snapshot():
            row = self._execute(f"SELECT npz, checksum {where.format('')}", (number, side)).fetchone()
            # A damaged index may hide a row. The search without the index is slower, so it runs only if none is found.
            if row is None and not self._execute(f"SELECT 1 {where.format('NOT INDEXED')}", (number, side)).fetchone():
                return None, None
        trajectory = None if row is None else read_trajectory(number, side, *row)
        if trajectory is None:
            raise self._unreadable(number, f"the {side}'s trajectory of its trial {number} cannot be read")
        return int(row[1]), trajectory

    def _write_trajectory(self, number: int, side: Side, trajectory: Trajectory | None) -> None:
        if side == "system":
            self._memory += _size(self._kept.pop(number, (None, None))[1])
        if trajectory is not None:
            values = rows.trajectory_row(number, side, trajectory)
            self._execute("INSERT INTO trajectories (trial, side, npz, checksum) VALUES (?, ?, ?, ?)", values)

    def __repr__(self) -> str:
        place = Shown("in memory") if self.path is None else self.path
        try:
            trials, waiting, _ = self.signature()
        except CtxvalError:
            return call(self, place, Shown("cannot be read"))
        return call(self, place, trials=trials, open=waiting)


def _size(trajectory: Trajectory | None) -> int:
    return 0 if trajectory is None else trajectory.times.nbytes + trajectory.states.nbytes + trajectory.inputs.nbytes
