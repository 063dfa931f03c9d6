"""Recovery of the readable parts of a store, whole or damaged, and their export as CSV and JSON."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

from ctxval._util.describe import describe
from ctxval._util.files import MADE_BY, write_text, written_whole
from ctxval._util.temporary import temporary_folder
from ctxval._util.texts import guarded, shortened, visible
from ctxval.campaign.storage import schema
from ctxval.campaign.storage.rows import COLUMNS, checksum_of, read_json, read_trajectory, read_trial
from ctxval.campaign.storage.store import Store
from ctxval.campaign.storage.trajectories import Side
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError, InputError, StoreAccessError

_TABLES = ("experiment", "settings", "history", "trials", "trajectories")

_UNREADABLE = (sqlite3.Error, CtxvalError, ValueError, TypeError, OverflowError, MemoryError, RecursionError)


@dataclass(eq=False)
class Recovered:
    """The readable parts of a store.

    Attributes:
        trials: the trials by number.
        trajectories: the trajectories by the number of their trial and their side.
        about: the tables experiment, settings and history.
        damaged: a sentence for each part that could not be read.
    """

    trials: dict[int, Trial] = field(default_factory=dict)
    trajectories: dict[tuple[int, Side], Trajectory] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    damaged: list[str] = field(default_factory=list)


def recover(path: Path) -> Recovered:
    """Read the readable parts of a store. The file is not changed if it is damaged or has a journal."""
    schema.require_file(path)
    if not path.is_file():
        raise StoreAccessError(f"there is no store at {path}.")
    recovered = Recovered()
    with _played_back(path, recovered) as readable:
        try:
            uri = f"file:{quote(str(readable.absolute()))}?mode=ro&immutable=1"
            connection = sqlite3.connect(uri, uri=True, factory=schema.Guarded)
        except sqlite3.Error as error:
            raise StoreAccessError(f"{path} cannot be read: {error}.") from error
        with closing(connection):
            _read(connection, path.stat().st_size, recovered)
    return recovered


@contextmanager
def _played_back(path: Path, recovered: Recovered) -> Iterator[Path]:
    """Yield the file to read: the store, or a copy into which the journal of a dead process was replayed."""
    journals = _left_journals(path)
    if not journals:
        try:
            Store.existing(path).close()
        except CtxvalError as error:
            recovered.damaged.append(str(error))
        yield path
        return
    with temporary_folder() as folder:
        copy = folder / "store.sqlite"
        try:
            # On a copy, because the journal of another database would destroy readable data.
            for file, ending in journals.items():
                shutil.copyfile(file, f"{copy}{ending}")
            Store.existing(copy).close()
        except (CtxvalError, OSError) as error:
            recovered.damaged.append(str(error).replace(str(copy), str(path)))
            copy = path
        yield copy


def _left_journals(path: Path) -> dict[Path, str]:
    """Return the store and the journals beside it, with their endings; empty if no journal stays.

    A journal that disappears during the checks belonged to a process that was writing.
    """
    for _ in range(20):
        journals = schema.beside(path)
        if not journals:
            return {}
        time.sleep(0.05)
    real = str(path.resolve())
    return {path: ""} | {journal: str(journal).removeprefix(real) for journal in journals}


def _read(connection: sqlite3.Connection, size: int, recovered: Recovered) -> None:
    try:
        # Without this SQLite refuses a file that is shorter than its header states.
        connection.execute("PRAGMA writable_schema = ON")
        tables = schema.plain_tables(connection, _TABLES)
    except _UNREADABLE as error:
        recovered.damaged.append(f"nothing is readable: {error}")
        return
    recovered.damaged += [
        f"the table {name} is missing, or is no plain table" for name in _TABLES if name not in tables
    ]
    reader = _Reader(connection, tables, size, recovered)
    for table in ("experiment", "settings"):
        recovered.about[table] = dict(reader.pairs(table))
    recovered.about["history"] = list(reader.history())
    for row in reader.rows("trials", [*(name.strip() for name in COLUMNS.split(",")), "checksum"]):
        reader.take_trial(row)
    for row in reader.rows("trajectories", ["trial", "side", "npz", "checksum"]):
        reader.take_trajectory(*row)


@dataclass(eq=False)
class _Reader:
    """Reads tables row by row, each row by its number, so that a damaged row does not hide the next one."""

    connection: sqlite3.Connection
    tables: dict[str, set[str]]
    size: int
    recovered: Recovered

    def pairs(self, table: str) -> Iterator[tuple[str, Any]]:
        for key, value in self.rows(table, ["key", "value"]):
            try:
                yield str(key), read_json(value, finite=False)
            except InputError as error:
                self._note(f"the table {table}, {key}: {error}")

    def history(self) -> Iterator[dict[str, Any]]:
        """Yield the changes of the store."""
        for at, what, why, content in self.rows("history", ["at", "what", "why", "content"]):
            try:
                yield {"at": str(at), "what": str(what), "why": str(why), "content": read_json(content, finite=False)}
            except InputError as error:
                self._note(f"the table history, {at}: {error}")

    def rows(self, table: str, columns: list[str]) -> Iterator[tuple[Any, ...]]:
        """Yield the readable rows of a table; a column that it does not have is None."""
        if table not in self.tables:
            return
        wanted = ", ".join(name if name in self.tables[table] else f"NULL AS {name}" for name in columns)
        unreadable: dict[str, list[int]] = {}
        for place in self._places(table):
            try:
                row = self.connection.execute(f"SELECT {wanted} FROM {table} WHERE rowid = ?", (place,)).fetchone()
            except _UNREADABLE as error:
                unreadable.setdefault(str(error), []).append(place)
                continue
            if row is not None:
                yield row
        for reason, places in unreadable.items():
            several = f"{len(places)} rows from {places[0]} to {places[-1]}"
            self._note(f"the table {table}, {several if len(places) > 1 else f'row {places[0]}'}: {reason}")

    def _places(self, table: str) -> list[int]:
        places: set[int] = set()
        try:
            places.update(place for (place,) in self.connection.execute(f"SELECT rowid FROM {table} NOT INDEXED"))
        except _UNREADABLE as error:
            self._note(f"the table {table}: {error}")
            # Rows behind the damage are recovered by their numbers; the size of the file limits how many there can be.
            last = 10_000
            with suppress(*_UNREADABLE):
                last = int(self.connection.execute(f"SELECT max(rowid) FROM {table}").fetchone()[0] or 0)
            places |= set(range(min(last + 1, self.size // 16)))  # a row has at least 16 bytes
        return sorted(places)

    def take_trial(self, row: tuple[Any, ...]) -> None:
        number, *values, checksum = row
        trial = read_trial((number, *values), checksum)
        if trial is not None and trial.number not in self.recovered.trials:
            self.recovered.trials[trial.number] = trial
        elif trial is not None:
            self._note(f"trial {number} is there more than once, and the first one is taken")
        elif checksum_of((number, *values)) == checksum:
            self._note(f"trial {number}: it holds what no trial can")
        else:
            self._note(f"trial {number}: its checksum does not fit")

    def take_trajectory(self, number: Any, side: Any, npz: Any, checksum: Any) -> None:
        name = f"the {side}'s trajectory of trial {number}"
        if side not in get_args(Side) or not isinstance(number, int):
            self._note(f"{name}: there is no such thing")
        elif (number, side) in self.recovered.trajectories:
            self._note(f"{name} is there more than once, and the first one is taken")
        elif trajectory := read_trajectory(number, side, npz, checksum):
            self.recovered.trajectories[number, side] = trajectory
        else:
            self._note(f"{name}: its checksum does not fit")

    def _note(self, sentence: str) -> None:
        self.recovered.damaged.append(shortened(sentence))


def export(recovered: Recovered, folder: Path) -> list[Path]:
    """Write trials.csv, trials.json and a CSV file of each trajectory."""
    try:
        (folder / "trajectories").mkdir(parents=True, exist_ok=True)
        paths = [folder / "trials.csv", folder / "trials.json"]
        rows = [_flat(trial) for trial in recovered.trials.values()]
        header = list(dict.fromkeys(name for row in rows for name in row))
        with written_whole(paths[0], text=True) as file:
            writer = csv.writer(file)
            writer.writerow([_cell(name) for name in header])
            writer.writerows([_cell(row.get(name)) for name in header] for row in rows)
        trials = [asdict(trial) | {"unit_point": trial.unit_point.tolist()} for trial in recovered.trials.values()]
        # A hundred levels are more than are ever read.
        content = describe({**recovered.about, "damaged": recovered.damaged, "trials": trials}, 100)
        write_text(paths[1], json.dumps({"made_by": MADE_BY, **content}, indent=1, allow_nan=False))
        for (number, side), trajectory in recovered.trajectories.items():
            paths.append(folder / "trajectories" / f"{number}.{side}.csv")
            trajectory.to_csv(paths[-1])
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error.strerror}.") from error
    return paths


def _cell(value: Any) -> Any:
    """Return a value as a cell of CSV; texts are made harmless for spreadsheets and terminals."""
    return guarded(visible(value)) if isinstance(value, str) else value


def _flat(trial: Trial) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for name, value in trial.parameters.items():
        entries = {name: value} if not isinstance(value, list) else {f"{name}[{i}]": v for i, v in enumerate(value)}
        parameters |= entries
    first, last = ("number", "origin", "state"), ("distance", "failure", "executed", "attempts", "seconds")
    return {
        **{name: getattr(trial, name) for name in first},
        **parameters,
        **{name: getattr(trial, name) for name in last},
    }
