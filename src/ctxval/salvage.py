"""What can be read of a store, whole or damaged, as CSV and JSON."""

from __future__ import annotations

import csv
import json
import sqlite3
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ctxval.errors import CtxvalError, InputError, StoreAccessError
from ctxval.rows import COLUMNS, read_trajectory, read_trial
from ctxval.store import Side, Store
from ctxval.trajectory import Trajectory
from ctxval.trial import Trial

_PROBED = 10_000
"""Numbers of trials that are tried where the file does not say how many there are."""

_UNREADABLE = (sqlite3.Error, CtxvalError, ValueError, TypeError, OverflowError, MemoryError, RecursionError)


@dataclass(eq=False)
class Salvage:
    """What was readable.

    Attributes:
        trials: by number.
        trajectories: by number and side.
        about: the tables experiment and settings.
        damaged: a sentence for each thing that was not readable.
    """

    trials: dict[int, Trial] = field(default_factory=dict)
    trajectories: dict[tuple[int, Side], Trajectory] = field(default_factory=dict)
    about: dict[str, dict[str, Any]] = field(default_factory=dict)
    damaged: list[str] = field(default_factory=list)


def salvage(path: Path) -> Salvage:
    """Read what is readable of a store; the file is not changed where it is damaged.

    Raises:
        StoreAccessError: there is no such file.
    """
    if not path.is_file():
        raise StoreAccessError(f"there is no store at {path}.")
    found = Salvage()
    try:
        # A whole store may have a journal of a process that died, which opening it plays back.
        Store.existing(path).close()
    except CtxvalError as error:
        found.damaged.append(str(error))
    connection = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)
    try:
        _read(connection, found)
    finally:
        connection.close()
    return found


def _read(connection: sqlite3.Connection, found: Salvage) -> None:
    try:
        # Or SQLite refuses a file that is shorter than it says.
        connection.execute("PRAGMA writable_schema = ON")
        columns = {row[1] for row in connection.execute("PRAGMA table_info(trials)")}
        kept = {row[1] for row in connection.execute("PRAGMA table_info(trajectories)")}
    except _UNREADABLE as error:
        found.damaged.append(f"nothing is readable: {error}")
        return
    for table in ("experiment", "settings"):
        found.about[table] = dict(_pairs(connection, table, found))
    names = [name.strip() for name in COLUMNS.split(",")]
    wanted = ", ".join(name if name in columns else f"NULL AS {name}" for name in (*names, "checksum"))
    # Older versions have no checksums.
    checksum = "checksum" if "checksum" in kept else "NULL"
    for number in _numbers(connection, found):
        _read_trial(connection, wanted, checksum, number, found)


def _pairs(connection: sqlite3.Connection, table: str, found: Salvage) -> Iterator[tuple[str, Any]]:
    try:
        for key, value in connection.execute(f"SELECT key, value FROM {table} ORDER BY rowid"):
            yield str(key), json.loads(value)
    except _UNREADABLE as error:
        found.damaged.append(f"the table {table}: {error}")


def _numbers(connection: sqlite3.Connection, found: Salvage) -> range:
    try:
        last = connection.execute("SELECT max(number) FROM trials").fetchone()[0]
    except sqlite3.Error:
        found.damaged.append("how many trials there were")
        return range(_PROBED)
    return range(0 if not isinstance(last, int) else min(last, 10**7) + 1)


def _read_trial(connection: sqlite3.Connection, wanted: str, checksum: str, number: int, found: Salvage) -> None:
    try:
        row = connection.execute(f"SELECT {wanted} FROM trials WHERE number = ?", (number,)).fetchone()
    except _UNREADABLE as error:
        found.damaged.append(f"trial {number}: {error}")
        row = None
    if row is not None:
        trial = read_trial(tuple(row[:-1]), row[-1])
        if trial is None:
            found.damaged.append(f"trial {number}: its checksum does not fit")
        else:
            found.trials[number] = trial
    for side in ("model", "system"):
        _read_trajectory(connection, number, side, checksum, found)


def _read_trajectory(connection: sqlite3.Connection, number: int, side: Side, checksum: str, found: Salvage) -> None:
    statement = f"SELECT npz, {checksum} FROM trajectories WHERE trial = ? AND side = ?"
    try:
        row = connection.execute(statement, (number, side)).fetchone()
        trajectory = None if row is None else read_trajectory(number, side, *row)
        if trajectory is not None:
            found.trajectories[number, side] = trajectory
        elif row is not None:
            found.damaged.append(f"the {side}'s trajectory of trial {number}: its checksum does not fit")
    except _UNREADABLE as error:
        found.damaged.append(f"the {side}'s trajectory of trial {number}: {error}")


def export(found: Salvage, folder: Path) -> list[Path]:
    """Write trials.csv, trials.json and a CSV file of each trajectory.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        (folder / "trajectories").mkdir(parents=True, exist_ok=True)
        paths = [folder / "trials.csv", folder / "trials.json"]
        _write_table(paths[0], found)
        trials = [asdict(trial) | {"unit_point": trial.unit_point.tolist()} for trial in found.trials.values()]
        content = {**found.about, "damaged": found.damaged, "trials": trials}
        paths[1].write_text(json.dumps(content, indent=1), encoding="utf-8")
        for (number, side), trajectory in found.trajectories.items():
            paths.append(folder / "trajectories" / f"{number}.{side}.csv")
            trajectory.to_csv(paths[-1])
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error.strerror}.") from error
    return paths


def _write_table(path: Path, found: Salvage) -> None:
    rows = [_flat(trial) for trial in found.trials.values()]
    header = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, header)
        writer.writeheader()
        writer.writerows(rows)


def _flat(trial: Trial) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for name, value in trial.parameters.items():
        entries = {name: value} if not isinstance(value, list) else {f"{name}[{i}]": v for i, v in enumerate(value)}
        parameters |= entries
    ended = ("distance", "failure", "executed", "attempts", "seconds")
    return {
        "number": trial.number,
        "origin": trial.origin,
        "state": trial.state,
        **parameters,
        **{name: getattr(trial, name) for name in ended},
    }
