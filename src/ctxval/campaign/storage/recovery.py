"""Recovery of the readable parts of a store, whole or damaged, and their export as CSV and JSON."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args

from ctxval._util.describe import describe
from ctxval._util.files import MADE_BY, temporary_folder, write_text, written_whole
from ctxval._util.texts import guarded, shortened, visible
from ctxval.campaign.storage import schema
from ctxval.campaign.storage.rows import COLUMNS, Side, read_json, read_trajectory, read_trial
from ctxval.campaign.storage.store import Store
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError, InputError, StoreAccessError

_COLUMNS = {
    "experiment": "key, value",
    "settings": "key, value",
    "history": "at, what, why, content",
    "trials": f"{COLUMNS}, checksum",
    "trajectories": "trial, side, npz, checksum",
}

_UNREADABLE = (sqlite3.Error, CtxvalError, ValueError, TypeError, OverflowError, MemoryError, RecursionError)


@dataclass(eq=False)
class Recovered:
    """The readable parts of a store."""

    trials: dict[int, Trial] = field(default_factory=dict)  #: the trials by number
    #: the trajectories by the number of their trial and their side
    trajectories: dict[tuple[int, Side], Trajectory] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)  #: the tables experiment, settings and history
    damaged: list[str] = field(default_factory=list)  #: a sentence for each part that could not be read

    def note(self, sentence: str) -> None:
        """Add a sentence on something that cannot be read."""
        self.damaged.append(shortened(sentence))


def recover(path: Path) -> Recovered:
    """Read the readable parts of a store. The file is not changed if it is damaged or has a journal."""
    schema.require_file(path)
    if not path.is_file():
        raise StoreAccessError(f"there is no store at {path}.")
    recovered = Recovered()
    with _played_back(path, recovered) as readable:
        try:
            connection = schema.read_only(readable)
        except sqlite3.Error as error:
            raise StoreAccessError(f"{path} cannot be read: {error}.") from error
        with closing(connection):
            try:
                # Without this SQLite refuses a file that is shorter than its header states.
                connection.execute("PRAGMA writable_schema = ON")
                tables = schema.plain_tables(connection, _COLUMNS)
            except _UNREADABLE as error:
                recovered.damaged.append(f"nothing is readable: {error}")
                tables = {}
            if tables:
                _read(connection, tables, path.stat().st_size, recovered)
    return recovered


@contextmanager
def _played_back(path: Path, recovered: Recovered) -> Iterator[Path]:
    """Yield the file to read: the store, or a copy into which the journal of a dead process was replayed."""
    for _ in range(20):
        journals = schema.beside(path)
        if not journals:  # a journal that disappears belonged to a process that was writing
            try:
                Store.existing(path).close()
            except CtxvalError as error:
                recovered.damaged.append(str(error))
            yield path
            return
        time.sleep(0.05)
    with temporary_folder() as folder:
        copy = folder / "store.sqlite"
        try:
            # On a copy, because the journal of another database would destroy readable data.
            shutil.copyfile(path, copy)
            for journal in journals:
                shutil.copyfile(journal, f"{copy}{str(journal).removeprefix(str(path.resolve()))}")
            Store.existing(copy).close()
        except (CtxvalError, OSError) as error:
            recovered.damaged.append(str(error).replace(str(copy), str(path)))
            copy = path
        yield copy


def _read(connection: sqlite3.Connection, tables: dict[str, set[str]], size: int, recovered: Recovered) -> None:
    about: dict[str, Any] = {"experiment": {}, "settings": {}, "history": []}
    recovered.about = about
    for table, names in _COLUMNS.items():
        if not set(names.split(", ")) <= tables.get(table, set()):
            recovered.damaged.append(f"the table {table} is missing, or is not that of a store")
            continue
        for row in _rows(connection, table, names, size, recovered):
            if table == "trials":
                try:
                    trial = read_trial(row[:-1], row[-1])
                    recovered.trials.setdefault(trial.number, trial)
                except InputError as error:
                    recovered.note(f"trial {row[0]}: {error}")
            elif table == "trajectories":
                number, side, npz, checksum = row
                name = f"the {side}'s trajectory of trial {number}"
                if side not in get_args(Side) or not isinstance(number, int):
                    recovered.note(f"{name}: there is no such thing")
                elif trajectory := read_trajectory(number, side, npz, checksum):
                    recovered.trajectories.setdefault((number, side), trajectory)
                else:
                    recovered.note(f"{name}: its checksum does not fit")
            else:
                try:
                    content = read_json(row[-1], finite=False)
                except InputError as error:
                    recovered.note(f"the table {table}, {row[0]}: {error}")
                    continue
                if table == "history":
                    at, what, why = map(str, row[:3])
                    about[table].append({"at": at, "what": what, "why": why, "content": content})
                else:
                    about[table][str(row[0])] = content


def _rows(
    connection: sqlite3.Connection, table: str, columns: str, size: int, recovered: Recovered
) -> Iterator[tuple[Any, ...]]:
    """Yield the readable rows of a table; behind a row that cannot be read, the scan begins again."""
    last, unreadable = -(2**63), dict[str, list[int]]()
    while last <= size // 16:  # a row has at least 16 bytes, so the size of the file limits how many there can be
        query = f"SELECT rowid, {columns} FROM {table} NOT INDEXED WHERE rowid > ? ORDER BY rowid"
        try:
            for place, *row in connection.execute(query, (last,)):
                if place > last:  # a damaged file may repeat its rows without end
                    last = place
                    yield tuple(row)
            break
        except _UNREADABLE as error:
            last = max(last + 1, 0)
            unreadable.setdefault(str(error), []).append(last)
    for reason, places in unreadable.items():
        which = f"{len(places)} rows from {places[0]} to {places[-1]}" if len(places) > 1 else f"row {places[0]}"
        recovered.note(f"the table {table}, {which}: {reason}")


def export(recovered: Recovered, folder: Path) -> list[Path]:
    """Write trials.csv, trials.json and a CSV file of each trajectory."""
    try:
        (folder / "trajectories").mkdir(parents=True, exist_ok=True)
        paths = [folder / "trials.csv", folder / "trials.json"]
        rows, after = list[dict[str, Any]](), ("distance", "failure", "executed", "attempts", "seconds")
        for trial in recovered.trials.values():
            row: dict[str, Any] = {name: getattr(trial, name) for name in ("number", "origin", "state")}
            for name, value in trial.parameters.items():
                row |= {f"{name}[{i}]": v for i, v in enumerate(value)} if isinstance(value, list) else {name: value}
            rows.append(row | {name: getattr(trial, name) for name in after})
        header = list(dict.fromkeys(name for row in rows for name in row))
        with written_whole(paths[0], text=True) as file:
            writer = csv.writer(file)
            writer.writerow([_cell(name) for name in header])
            writer.writerows([_cell(row.get(name)) for name in header] for row in rows)
        trials = [
            asdict(trial) | {"unit_point": trial.unit_point.tolist(), "note": trial.note.to_json() or None}
            for trial in recovered.trials.values()
        ]
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
