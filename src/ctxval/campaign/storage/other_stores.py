"""What a store says to a certificate besides its trials, and the other stores of the same experiment beside it.

A verdict that is chosen among several stores is wrong more often than one verdict.
"""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from ctxval._util.describe import first_difference
from ctxval.campaign.storage import schema
from ctxval.campaign.storage.rows import COLUMNS, MOST_CHARACTERS, read_trial
from ctxval.campaign.storage.store import Store
from ctxval.certificates import Neighbour, Provenance
from ctxval.core.trial import Trial

STORE_SUFFIXES = (".sqlite", ".sqlite3", ".db")  #: suffixes of files that are taken for stores
_UNREADABLE = (sqlite3.Error, OSError, ValueError, TypeError, OverflowError, MemoryError, RecursionError)


def provenance_of_store(store: Store) -> Provenance:
    """Return what a store says besides its trials. Nothing is written, and no code is imported or run."""
    with store.snapshot():
        description, changes, thresholds = store.description(), store.history(), store.thresholds()
    beside = () if store.path is None else other_stores(store.path)
    return Provenance.of(description, changes, thresholds, beside)


def other_stores(path: Path) -> list[Neighbour]:
    """Return other stores beside a store with trials of the same validation and model, each with its worst trial.

    Nothing is built, run or written. Files that cannot be read are skipped.
    """
    others = []
    with suppress(*_UNREADABLE):
        validation, _ = _read(path)
        beside = sorted(file for file in path.absolute().parent.iterdir() if file.suffix in STORE_SUFFIXES)[:500]
        for file in beside:
            with suppress(*_UNREADABLE):
                if file.name == path.name or not file.is_file():
                    continue
                of_file, worst = _read(file)
                if first_difference(validation, of_file) is None:
                    others.append(Neighbour(path.with_name(file.name), worst))
    return others


def _read(path: Path) -> tuple[dict[str, Any], Trial | None]:
    """Return a store's description of its validation with the number that depends on its model, and its worst trial."""
    with closing(schema.read_only(path)) as connection:
        if schema.difference(connection, schema.TABLES) is not None:
            raise ValueError(f"{path} is not a store")
        rows = connection.execute(
            "SELECT key, value FROM experiment WHERE key IN ('validation', 'draws') AND length(value) <= ?",
            (MOST_CHARACTERS,),
        ).fetchall()
        executed = connection.execute("SELECT EXISTS (SELECT 1 FROM trials WHERE executed)").fetchone()[0]
        row = connection.execute(
            f"SELECT {COLUMNS}, checksum FROM trials WHERE typeof(distance) = 'real' ORDER BY distance DESC LIMIT 1"
        ).fetchone()
    experiment = {str(key): json.loads(value) for key, value in rows}
    if not isinstance(experiment.get("validation"), dict) or not executed:
        raise ValueError(f"{path} has no executed trials of an experiment")
    return experiment, None if row is None else read_trial(row[:-1], row[-1])
