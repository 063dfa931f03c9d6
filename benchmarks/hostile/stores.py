"""Hostile stores: files that a stranger sends, and that call themselves stores."""

from __future__ import annotations

import json
import os
import shutil
import socket
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

from ctxval.campaign.storage.rows import COLUMNS, checksum_of
from hostile import archives
from hostile.values import (
    ESCAPES,
    PWNED,
    REFERENCES,
    TEXTS,
    Rng,
    as_json,
    mutated,
    nested,
    number,
    pick,
    text,
    value,
)

NAME = "a.sqlite"
Change = Callable[[sqlite3.Connection, Rng], None]


def damaged(rng: Rng, folder: Path, base: Path) -> None:
    """Write a store of which some bytes are others."""
    data = base.read_bytes()
    if rng.random() < 0.15:
        data = data[:100] + mutated(rng, data[100:])
    elif rng.random() < 0.3:
        head = bytearray(data)
        for _ in range(int(rng.integers(1, 5))):
            head[int(rng.integers(100))] = int(rng.integers(256))
        data = bytes(head)
    else:
        data = mutated(rng, data)
    (folder / NAME).write_bytes(data)
    if rng.random() < 0.1:
        (folder / f"{NAME}{pick(rng, ('-journal', '-wal', '-shm', '.lock'))}").write_bytes(
            pick(rng, (b"", rng.bytes(3000), data, b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + rng.bytes(1000)))
        )


def crafted(rng: Rng, folder: Path, base: Path) -> None:
    """Write a store whose tables are sound for SQLite, and hostile for us."""
    path = folder / NAME
    shutil.copy(base, path)
    (folder / "pwned.py").write_text(PWNED)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = OFF")
        connection.execute("PRAGMA writable_schema = ON")
        # A trigger that never ends may meet the change that comes after it.
        connection.set_progress_handler(lambda: 1, 3_000_000)
        for _ in range(int(rng.integers(1, 4))):
            with suppress(sqlite3.Error, OverflowError, ValueError):
                pick(rng, CHANGES)(connection, rng)


def no_store(rng: Rng, folder: Path, base: Path) -> None:
    """Put something in the place of a store that is none."""
    pick(rng, NO_STORES)(folder / NAME, rng, base)


def coded(rng: Rng, folder: Path, base: Path) -> None:
    """Write a store whose settings name code in every place that there is."""
    path = folder / NAME
    shutil.copy(base, path)
    (folder / "pwned.py").write_text(PWNED)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = OFF")
        _name_code(connection, rng)


# Changes of a sound store


def _name_code(connection: sqlite3.Connection, rng: Rng) -> None:
    where = str(pick(rng, ("system", "model", "synthesizer", "distance", "task", "experiment", "search", "options")))
    name = str(pick(rng, REFERENCES))
    table = {"type": name, "args": "touch PWNED", "shell": True}
    content: object = pick(
        rng,
        (
            *(
                name,
                table,
                {"type": "Simulated", "step": {"ref": name}},
                {"type": "Function", "function": {"ref": name}},
            ),
            *({"ref": name}, {"type": "Subprocess", "command": "touch PWNED"}, {"name": name}, {"type": name}),
            *({"type": "FMU", "source": "a.fmu"}, {"type": "Linear", "A": {"ref": name}, "B": [[1.0]]}, [name]),
            *({"type": "MuJoCo", "mjcf": "/dev/zero"}, {"type": "Gymnasium", "environment": "pwned:x"}),
            *(
                {"type": "random", "rng": {"ref": name}},
                {"type": "GaussianProcessModel", "data": {"logs": ["/dev/zero"]}},
            ),
            *({"type": "Onnx", "path": "../../../etc/passwd"}, {"type": "Policy", "function": {"ref": name}}),
        ),
    )
    _set(connection, "settings", where, json.dumps(content))
    if where == "experiment":
        for key in ("space", "task", "system", "model", "synthesizer", "distance", "name"):
            _set(connection, "settings", key, "null")


def _set(connection: sqlite3.Connection, table: str, key: str, content: object) -> None:
    connection.execute(f"INSERT OR REPLACE INTO {table} (key, value) VALUES (?, ?)", (key, content))


def _settings(connection: sqlite3.Connection, rng: Rng) -> None:
    keys = [row[0] for row in connection.execute("SELECT key FROM settings")]
    _set(connection, "settings", str(pick(rng, [*keys, text(rng, 50)])), as_json(rng, value(rng)))


def _options(connection: sqlite3.Connection, rng: Rng) -> None:
    """Name a case of ours with options that ask for much."""
    for key in ("space", "task", "system", "model", "synthesizer", "distance", "name"):
        _set(connection, "settings", key, "null")
    _set(connection, "settings", "experiment", json.dumps(pick(rng, ("pendulum", "dubins", "linear", "arm", "none"))))
    options = {pick(rng, ("dim", "variant", "model", "horizon", "settings", "seed")): value(rng)}
    _set(connection, "settings", "options", as_json(rng, options))


def _experiment(connection: sqlite3.Connection, rng: Rng) -> None:
    keys = [row[0] for row in connection.execute("SELECT key FROM experiment")]
    _set(connection, "experiment", str(pick(rng, [*keys, text(rng, 50)])), as_json(rng, value(rng)))


def _raw_pair(connection: sqlite3.Connection, rng: Rng) -> None:
    table = pick(rng, ("settings", "experiment"))
    content = pick(rng, (rng.bytes(50), nested(rng), 1.5, 7, b"{}", "\x00", "NaN", "Infinity", "-1e999", '"\ud800"'))
    connection.execute(f"UPDATE {table} SET value = ? WHERE rowid % 3 = ?", (content, int(rng.integers(3))))


def _version(connection: sqlite3.Connection, rng: Rng) -> None:
    name = pick(rng, ("user_version", "application_id"))
    connection.execute(f"PRAGMA {name} = {pick(rng, (-1, -5, 0, 1, 2, 3, 4, 6, 99, 2**31 - 1, -(2**31)))}")


def _no_checksums(connection: sqlite3.Connection, rng: Rng) -> None:
    connection.execute(f"UPDATE {pick(rng, ('trials', 'trajectories'))} SET checksum = NULL")


def _cell(connection: sqlite3.Connection, rng: Rng) -> None:
    """Change a trial as its writer would, with a checksum that fits, or none, or as it was."""
    columns = COLUMNS.split(", ")
    name = str(pick(rng, columns))
    contents = {
        "unit_point": (as_json(rng, [value(rng)]), "[1e999]", "[]", "[NaN]", "[2.0, 2.0]", "[-1, 0.5]", nested(rng)),
        "parameters": (as_json(rng, value(rng)), nested(rng), json.dumps({text(rng, 99): value(rng)}), "{}", "[]"),
        "failure": (text(rng), str(pick(rng, ESCAPES)) * 20, "x" * 5_000_000, "\\[bold]", b"\xff\xfe"),
        "note": (as_json(rng, value(rng)), nested(rng), '{"kind": "climb"}', "[1, 2, 3]"),
        "state": ("open", "completed", "failed", "unmeasured", "gone", "", text(rng, 99)),
        "origin": ("iid", "initial", "acquisition", "manual", "covering", "gone", text(rng, 99)),
    }
    content = pick(rng, contents.get(name, (number(rng), number(rng), text(rng, 99), None, b"\x00", "1e999")))
    which = int(rng.integers(5))
    connection.execute("PRAGMA ignore_check_constraints = ON")
    connection.execute(f"UPDATE trials SET {name} = ? WHERE number = ?", (content, which))
    if rng.random() < 0.7:
        for row in connection.execute(f"SELECT {COLUMNS}, rowid FROM trials").fetchall():
            connection.execute("UPDATE trials SET checksum = ? WHERE rowid = ?", (checksum_of(row[:-1]), row[-1]))


def _many(connection: sqlite3.Connection, rng: Rng) -> None:
    """Add trials whose numbers, or whose number, is large."""
    last = int(pick(rng, (10, 2_000, 10**7, 2**40, 2**62)))
    columns = COLUMNS.replace("number, ", "")
    places = range(6, last) if last <= 2_000 else [last]
    connection.executemany(
        f"INSERT OR IGNORE INTO trials (number, {columns}, opened_at) SELECT ?, {columns}, 'now' FROM trials LIMIT 1",
        [(place,) for place in places],
    )


def _view(connection: sqlite3.Connection, rng: Rng) -> None:
    """Put a view that never ends, or that gives anything, in the place of a table."""
    table = str(pick(rng, ("trials", "trajectories", "settings", "experiment", "history")))
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    connection.execute("PRAGMA legacy_alter_table = ON")
    connection.execute(f"ALTER TABLE {table} RENAME TO old_{table}")
    endless = "WITH RECURSIVE c(n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM c)"
    selects = (
        f"{endless} SELECT {', '.join(f'n AS {name}' for name in columns)} FROM c",
        f"SELECT {', '.join(f'o.{name}' for name in columns)} FROM old_{table} o, old_{table} p, old_{table} q",
        f"SELECT {', '.join(f'zeroblob(500000000) AS {name}' for name in columns)}",
        f"SELECT * FROM {table}",
        "SELECT load_extension('pwned')",
        f"{endless} SELECT {', '.join(f'max(n) AS {name}' for name in columns)} FROM c",
    )
    connection.execute(f"CREATE VIEW {table} AS {pick(rng, selects)}")


def _trigger(connection: sqlite3.Connection, rng: Rng) -> None:
    table = pick(rng, ("trials", "trajectories", "settings"))
    endless = "WITH RECURSIVE c(n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM c) SELECT count(*) FROM c"
    acts = (
        *(f"{endless};", "SELECT RAISE(FAIL, 'no');", "DELETE FROM trials;", "SELECT RAISE(ROLLBACK, '\x1b[2J');"),
        "UPDATE trials SET distance = 0.0 WHERE number = 0;",
        "INSERT INTO settings VALUES (hex(randomblob(20)), zeroblob(100000000));",
    )
    when, act = pick(rng, ("BEFORE", "AFTER")), pick(rng, ("INSERT", "UPDATE", "DELETE"))
    connection.execute(f"CREATE TRIGGER t{rng.integers(99)} {when} {act} ON {table} BEGIN {pick(rng, acts)} END")


def _schema(connection: sqlite3.Connection, rng: Rng) -> None:
    table = str(pick(rng, ("trials", "trajectories", "settings", "experiment", "history")))
    column = pick(rng, [row[1] for row in connection.execute(f"PRAGMA table_info({table})")])
    statements = (
        f"DROP TABLE {table}",
        f"ALTER TABLE {table} DROP COLUMN {column}",
        f"ALTER TABLE {table} RENAME COLUMN {column} TO gone",
        f"ALTER TABLE {table} ADD COLUMN more AS (zeroblob(900000000))",
        f"CREATE TABLE again AS SELECT * FROM {table}",
        f"CREATE INDEX i{rng.integers(99)} ON {table} ({column})",
        "CREATE VIRTUAL TABLE v USING fts5(x)",
        f"UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', '') WHERE name = '{table}'",
        f"UPDATE sqlite_master SET sql = 'CREATE TABLE {table} (x)' WHERE name = '{table}'",
        f"UPDATE sqlite_master SET rootpage = {int(rng.integers(60))} WHERE name = '{table}'",
        f"UPDATE sqlite_master SET sql = '{pick(rng, ('', 'garbage', 'CREATE', 'x' * 99))}' WHERE name = '{table}'",
        "PRAGMA journal_mode = WAL",
        "PRAGMA page_size = 65536",
        "VACUUM",
        f"DELETE FROM {table} WHERE rowid % 2",
    )
    connection.execute(str(pick(rng, statements)))


def _trajectory(connection: sqlite3.Connection, rng: Rng) -> None:
    contents = (archives.npz(rng), archives.npz(rng), b"", "text", 7, None, rng.bytes(3000))
    content = pick(rng, contents)
    number_, side = int(rng.integers(5)), pick(rng, ("model", "system"))
    connection.execute("UPDATE trajectories SET npz = ? WHERE trial = ? AND side = ?", (content, number_, side))
    if rng.random() < 0.8:
        fits = checksum_of((number_, side, content)) if rng.random() < 0.7 else None
        connection.execute("UPDATE trajectories SET checksum = ? WHERE trial = ? AND side = ?", (fits, number_, side))


def _large(connection: sqlite3.Connection, rng: Rng) -> None:
    size = int(pick(rng, (10_000_000, 60_000_000)))
    statements = (
        f"UPDATE trajectories SET npz = zeroblob({size}), checksum = NULL",
        f"UPDATE trials SET failure = hex(zeroblob({size})), checksum = NULL WHERE number = 1",
        f"UPDATE settings SET value = '\"' || hex(zeroblob({size})) || '\"' WHERE key = 'name'",
        f"UPDATE trials SET parameters = '[' || hex(zeroblob({size})) || ']' WHERE number = 0",
    )
    connection.execute(str(pick(rng, statements)))


CHANGES: tuple[Change, ...] = (
    *(_cell, _cell, _cell, _cell, _settings, _settings, _experiment, _raw_pair, _options, _name_code, _version),
    *(_no_checksums, _many, _view, _view, _trigger, _schema, _schema, _trajectory, _trajectory, _large),
)


# What is no store


def _fifo(path: Path, rng: Rng, base: Path) -> None:
    os.mkfifo(path)


def _folder(path: Path, rng: Rng, base: Path) -> None:
    path.mkdir()
    (path / "x").write_text("x")


def _link(path: Path, rng: Rng, base: Path) -> None:
    path.symlink_to(
        str(pick(rng, ("/dev/zero", "/dev/urandom", "/dev/full", "/dev/null", NAME, "none", "/", "/proc/self/mem")))
    )


def _socket(path: Path, rng: Rng, base: Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # names of sockets are short
    try:
        with socket.socket(socket.AF_UNIX) as opened:
            opened.bind(path.name)
    finally:
        os.chdir(here)


def _sparse(path: Path, rng: Rng, base: Path) -> None:
    path.write_bytes(base.read_bytes() if rng.random() < 0.5 else b"")
    os.truncate(path, int(pick(rng, (2**20, 2**31, 2**35, 2**40))))


def _bytes(path: Path, rng: Rng, base: Path) -> None:
    header = b"SQLite format 3\0"
    path.write_bytes(
        pick(rng, (b"", b"\0", header, header + rng.bytes(5000), rng.bytes(5000), text(rng).encode("utf-8", "replace")))
    )


def _other(path: Path, rng: Rng, base: Path) -> None:
    """Write a database of something else, perhaps with our mark."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(f"PRAGMA encoding = '{pick(rng, ('UTF-16le', 'UTF-16be', 'UTF-8'))}'")
        connection.execute(f"CREATE TABLE {pick(rng, ('trials', 'x'))} (number, value)")
        connection.execute(f"PRAGMA application_id = {pick(rng, (0, 0x63747876))}")
        connection.execute(f"PRAGMA user_version = {pick(rng, (0, 1, 5, -1, 99))}")
        connection.commit()


def _around(path: Path, rng: Rng, base: Path) -> None:
    """Put something into the places of the files that a store has beside it."""
    shutil.copy(base, path)
    beside = path.with_name(f"{NAME}{pick(rng, ('-journal', '-wal', '.lock', '.lock-journal'))}")
    match int(rng.integers(4)):
        case 0:
            beside.mkdir()
        case 1:
            os.mkfifo(beside)
        case 2:
            beside.symlink_to(str(pick(rng, ("/dev/zero", "/dev/full", "/", NAME))))
        case 3:
            beside.write_bytes(rng.bytes(5000))


NO_STORES = (_fifo, _folder, _link, _link, _socket, _sparse, _bytes, _bytes, _other, _around)


_EXPERIMENTS = ("tell", "ask", "import", "remeasure")
"""Commands that build the experiment of a store, which may be named again."""


def commands(rng: Rng) -> tuple[str, ...]:
    """Return a command line that takes a store."""
    json_ = ("--json",) if rng.random() < 0.4 else ()
    tell = (
        ("--distance", str(pick(rng, ("0.1", "0", "1e300", "nan", "-1")))),
        ("--failed", str(pick(rng, ("the motor cut out", *(t for t in TEXTS if "\0" not in t))))),
        ("--trajectory", "run.csv"),
        ("--npz", "run.npz"),
    )
    options: list[tuple[str, ...]] = [
        ("status", NAME),
        ("status", NAME),
        ("export", NAME),
        ("export", NAME, "--out", "saved"),
        ("certify", NAME, "--threshold", "0.5", "--kind", "scenario"),
        ("certify", NAME, "--threshold", "0.01"),
        ("tell", NAME, str(rng.integers(6)), *pick(rng, tell)),
        ("ask", NAME),
        ("ask", NAME, "--set", "goal=1.0", "--set", "load=0.1"),
        ("ask", NAME, "--trial", str(rng.integers(6))),
        ("ask", NAME, "--again", "0"),
        ("ask", NAME, "--draw"),
        ("import", NAME, "table.csv"),
        ("remeasure", NAME),
        ("report", NAME, "--out", "r.html", *pick(rng, ((), ("--markdown", "r.md", "--junit", "r.xml")))),
        ("remeasure", NAME, "--accept-change", str(pick(rng, [t for t in TEXTS if "\0" not in t]))),
        ("certify", NAME, "--audit", "6", "--kind", "scenario"),
    ]
    own = ("--experiment", "experiment.toml") if rng.random() < 0.15 else ()
    run = "run", "experiment.toml", "--store", NAME, "--budget", "4", "--search", "random"
    chosen = run if rng.random() < 0.03 else pick(rng, options)  # running draws pictures, which takes a second
    return (*chosen, *(own if chosen[0] in _EXPERIMENTS else ()), *json_)
