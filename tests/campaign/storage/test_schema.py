"""Files that are laid out as no store is, and what lies beside them: one sentence each, and nothing is run."""

from __future__ import annotations

import os
import random
import shutil
import socket
import sqlite3
import struct
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from conftest import make_validation
from ctxval import Campaign, Store, searches
from ctxval.campaign.storage import recovery, schema
from ctxval.campaign.storage.recovery import recover
from ctxval.cli import app
from ctxval.errors import CtxvalError, ForeignStoreError, StoreAccessError
from facts import assert_names, refuses

FOREVER = "WITH RECURSIVE t(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM t) SELECT {} FROM t"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "whole.sqlite"
    campaign = Campaign(make_validation(horizon=3), search=searches.Random(), store=path, seed=2).run(4)
    campaign.tell(campaign.ask(), failed="motor stalled")
    campaign.store.close()
    return path


@pytest.fixture
def store(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(whole, tmp_path / "a.sqlite"))


def edit(path: Path, *statements: str) -> None:
    connection = sqlite3.connect(path, isolation_level=None)
    for statement in statements:
        connection.execute(statement)
    connection.close()


@pytest.fixture(autouse=True)
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give no time to a process that might be writing a journal: here, none is."""
    monkeypatch.setattr(recovery, "time", SimpleNamespace(sleep=lambda seconds: None))


def said(path: Path, *command: str) -> str:
    result = CliRunner().invoke(app, [*(command or ("status",)), str(path)])
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def columns(table: str) -> str:
    connection = sqlite3.connect(":memory:")
    connection.executescript(schema.TABLES)
    names = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    connection.close()
    return ", ".join(names)


VIEW = f"CREATE VIEW trials AS {FOREVER.format(', '.join(f'x AS {name}' for name in columns('trials').split(', ')))}"

CRAFTED: dict[str, tuple[tuple[str, ...], str, int]] = {
    "an endless view of trials": (("DROP TABLE trials", VIEW), "it has a view 'trials'", 0),
    "an endless view of settings": (
        ("DROP TABLE settings", f"CREATE VIEW settings AS {FOREVER.format('x AS key, x AS value')}"),
        "it has a view 'settings'",
        5,
    ),
    "one more view": ((f"CREATE VIEW other AS {FOREVER.format('x')}",), "it has a view 'other'", 5),
    "a trigger": (
        ("CREATE TRIGGER t AFTER UPDATE ON trials BEGIN DELETE FROM trajectories; END",),
        "it has a trigger 't'",
        5,
    ),
    "an index": (("CREATE INDEX i ON trials (abs(distance))",), "it has an index 'i'", 5),
    "a column more": (("ALTER TABLE trials ADD COLUMN extra TEXT",), "its table 'trials' is another one", 5),
    "a computed column": (
        ("ALTER TABLE trials ADD COLUMN extra AS (hex(zeroblob(100000000)))",),
        "its table 'trials' is another one",
        0,
    ),
    "a column less": (("ALTER TABLE trials DROP COLUMN seconds",), "its table 'trials' is another one", 0),
    "a table less": (("DROP TABLE settings",), "its table 'settings' is missing", 5),
    "a virtual table": (
        ("DROP TABLE trials", f"CREATE VIRTUAL TABLE trials USING fts5({columns('trials')})"),
        "it has a table 'trials_data'",
        0,
    ),
    "no key": (
        (
            "CREATE TABLE other AS SELECT * FROM trials",
            "DROP TABLE trials",
            "ALTER TABLE other RENAME TO trials",
            "INSERT INTO trials SELECT * FROM trials",
        ),
        "its table 'trials' is another one",
        5,
    ),
    "a version below zero": (("PRAGMA user_version = -3",), "has schema version -3 of an older", 5),
    "the lowest version": (("PRAGMA user_version = -2147483648",), "has schema version -2147483648 of an older", 5),
    "version zero": (("PRAGMA user_version = 0",), "has schema version 0 of an older", 5),
    "an older version": (("PRAGMA user_version = 2",), "has schema version 2 of an older", 5),
}


@pytest.mark.parametrize("name", CRAFTED)
def test_a_crafted_store_is_refused_and_export_saves_the_rest(store: Path, tmp_path: Path, name: str) -> None:
    statements, sentence, trials = CRAFTED[name]
    edit(store, *statements)
    before = store.read_bytes()
    for command in ("status", "certify"):
        assert sentence in said(store, command)
    found = recover(store)
    assert len(found.trials) == trials
    assert len(found.trajectories) == 9
    assert found.damaged
    assert CliRunner().invoke(app, ["export", str(store), "--out", str(tmp_path / "out")]).exit_code == 0
    assert store.read_bytes() == before


ROWS: dict[str, tuple[str, str]] = {
    "no checksum": ("UPDATE trials SET distance = 0.0, checksum = 0 WHERE number = 2", "its trial 2"),
    "no checksum of a trajectory": ("UPDATE trajectories SET checksum = 0 WHERE trial = 2", ""),
    "a gap": ("UPDATE trials SET number = 9000000000000000000 WHERE number = 2", "its trial 2"),
    "below zero": ("UPDATE trials SET number = -1 WHERE number = 2", "its trial 0"),
    "no JSON in the experiment": ("UPDATE experiment SET value = '{' WHERE key = 'seed'", "the experiment in it"),
    "deep JSON": (
        f"UPDATE experiment SET value = '{'[' * 900}{']' * 900}' WHERE key = 'seed'",
        "the experiment in it",
    ),
    "bytes": ("UPDATE experiment SET value = x'80ff' WHERE key = 'seed'", "the experiment in it"),
}


@pytest.mark.parametrize("name", ROWS)
def test_crafted_rows_are_one_sentence_and_export_saves_the_rest(store: Path, tmp_path: Path, name: str) -> None:
    statement, sentence = ROWS[name]
    edit(store, statement)
    if sentence:
        assert sentence in said(store)
    else:
        with refuses(ForeignStoreError, 2, "a.sqlite"):
            Store.existing(store).trajectory(2, "model")
    found = recover(store)
    assert len(found.trials) >= 4
    assert found.damaged
    assert CliRunner().invoke(app, ["export", str(store), "--out", str(tmp_path / "out")]).exit_code == 0


def test_a_text_that_is_not_utf_8_is_one_sentence(store: Path) -> None:
    edit(store, "UPDATE trials SET failure = CAST(x'80ff' AS TEXT) WHERE number = 4")
    assert_names(said(store), 4)
    assert len(recover(store).trials) == 4


def test_a_store_of_another_spelling_is_a_store(store: Path) -> None:
    edit(
        store,
        "PRAGMA writable_schema = ON",
        "UPDATE sqlite_master SET sql = replace(sql, 'CREATE TABLE settings (', 'CREATE TABLE \"settings\"(')",
    )
    assert len(Store.existing(store).trials()) == 5


# What is no file


def test_a_pipe_is_no_store(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.sqlite")
    for command in ("status", "certify", "export"):
        assert "a FIFO" in said(tmp_path / "a.sqlite", command)
    with refuses(StoreAccessError, "FIFO", "a.sqlite"):
        Store(tmp_path / "a.sqlite")


def test_what_is_no_file_is_no_store(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    with socket.socket(socket.AF_UNIX) as unix:
        unix.bind(str(tmp_path / "s"))
        for name in ("loop", "zero", "folder", "s", "none"):
            for command in ("status", "certify", "export"):
                assert name in said(tmp_path / name, command)
            if name != "none":
                with refuses(StoreAccessError, name):
                    Store(tmp_path / name)


def test_an_unreadable_file_is_one_sentence(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store.chmod(0)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root reads everything
    with refuses(StoreAccessError, "a.sqlite"):
        Store.existing(store)


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["-journal", "-wal", "-shm"])
@pytest.mark.parametrize("kind", ["pipe", "link", "folder"])
def test_what_lies_beside_must_be_a_file(store: Path, tmp_path: Path, ending: str, kind: str) -> None:
    beside = tmp_path / f"a.sqlite{ending}"
    victim = tmp_path / "thesis.tex"
    victim.write_text("chapter 1")
    {"pipe": lambda: os.mkfifo(beside), "link": lambda: beside.symlink_to(victim), "folder": beside.mkdir}[kind]()
    assert_names(said(store), f"a.sqlite{ending}")
    assert len(recover(store).trials) == 5
    assert victim.read_text() == "chapter 1"


# Journals


def journal(of: Path, *, pages: int = 1, names: Path | None = None) -> bytes:
    """Return a journal that puts noise into the first pages, and names a file of several transactions."""
    rng, page, nonce = random.Random(0), 4096, 77
    header = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + struct.pack(">IIIII", pages, nonce, 1, 512, page)
    records = b""
    for number in range(1, pages + 1):
        content = rng.randbytes(page)
        checksum = (nonce + sum(content[page - 200 * k] for k in range(1, (page - 1) // 200 + 1))) % 2**32
        records += struct.pack(">I", number) + content + struct.pack(">I", checksum)
    if names is None:
        return header.ljust(512, b"\0") + records
    name = str(names).encode()
    lock_page = struct.pack(">I", 2**30 // page + 1)
    trailer = lock_page + name + struct.pack(">II", len(name), sum(name)) + header[:8]
    return header.ljust(512, b"\0") + records + trailer


@pytest.mark.slow
def test_a_journal_that_names_another_file_deletes_nothing(store: Path, tmp_path: Path) -> None:
    victim = tmp_path / "thesis.tex"
    victim.write_text("chapter 1\n")
    (tmp_path / "a.sqlite-journal").write_bytes(journal(store, names=victim))
    said(store)
    assert len(recover(store).trials) == 5
    assert victim.exists()


@pytest.mark.slow
def test_the_journal_of_another_database_is_one_sentence_and_export_reads_the_store(store: Path) -> None:
    beside = store.with_name("a.sqlite-journal")
    beside.write_bytes(journal(store, pages=3))
    before = store.read_bytes()
    found = recover(store)
    assert (len(found.trials), store.read_bytes()) == (5, before)
    assert len(found.damaged) == 1
    assert "store.sqlite" not in found.damaged[0]
    assert "store" in said(store)


@pytest.mark.slow
def test_the_journal_of_a_process_that_died_is_played_back_on_export(store: Path, tmp_path: Path) -> None:
    connection = sqlite3.connect(store, isolation_level=None)
    connection.execute("PRAGMA cache_size = 1")
    connection.execute("PRAGMA cache_spill = 1")
    connection.execute("BEGIN IMMEDIATE")
    connection.execute("DELETE FROM trajectories")
    connection.execute("UPDATE trials SET failure = ?", ("x" * 200_000,))
    died = tmp_path / "died.sqlite"
    shutil.copy(store, died)
    shutil.copy(f"{store}-journal", f"{died}-journal")
    connection.execute("ROLLBACK")
    connection.close()
    before = died.read_bytes()
    assert before != store.read_bytes()
    found = recover(died)
    assert (len(found.trials), len(found.trajectories), found.damaged) == (5, 9, [])
    assert died.read_bytes() == before
    assert len(Store.existing(died).trials()) == 5


@pytest.mark.slow
def test_a_store_in_wal_mode_becomes_one_file_again(store: Path, tmp_path: Path) -> None:
    connection = sqlite3.connect(store, isolation_level=None)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("UPDATE trials SET closed_at = 'then'")
    left = tmp_path / "left.sqlite"
    for ending in ("", "-wal"):
        shutil.copy(f"{store}{ending}", f"{left}{ending}")
    connection.close()
    assert (len(recover(left).trials), recover(left).damaged) == (5, [])
    opened = Store.existing(left)
    assert len(opened.trials()) == 5
    assert opened._execute("PRAGMA journal_mode").fetchone()[0] == "delete"
    assert [path.name for path in tmp_path.glob("left*")] == ["left.sqlite"]
    left.with_name("left.sqlite-wal").write_bytes(b"\x37\x7f\x06\x82" + random.Random(1).randbytes(9000))
    assert len(Store.existing(left).trials()) == 5


# Nothing goes on for ever


def test_no_statement_goes_on_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schema, "STEPS", 10**6)
    connection = sqlite3.connect(":memory:", factory=schema.Guarded)
    for _ in range(2):
        with refuses(sqlite3.OperationalError, "interrupted"):
            connection.execute(FOREVER.format("count(*)")).fetchone()
        for _ in range(300):  # each statement is counted anew
            connection.execute(f"{FOREVER.format('count(*)').replace('FROM t)', 'FROM t LIMIT 1000)')}").fetchone()
    connection.close()


def tree_of_itself(path: Path) -> None:
    """Make the root page of the trials an interior page whose children are all the page that holds the rows."""
    edit(path, "VACUUM")
    connection = sqlite3.connect(path, isolation_level=None)
    size = connection.execute("PRAGMA page_size").fetchone()[0]
    root = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'trials'").fetchone()[0]
    pages = connection.execute("PRAGMA page_count").fetchone()[0]
    connection.close()
    data = bytearray(path.read_bytes())
    leaf = bytes(data[(root - 1) * size : root * size])

    def interior(child: int) -> bytes:
        count = 300
        cells = b"".join(struct.pack(">IB", child, 1) for _ in range(count))
        start = size - len(cells)
        pointers = b"".join(struct.pack(">H", start + 5 * k) for k in range(count))
        return (struct.pack(">BHHHBI", 5, 0, count, start, 0, child) + pointers).ljust(start, b"\0") + cells

    # root -> pages + 1 -> ... -> the leaf, 300 times at each level
    data[(root - 1) * size : root * size] = interior(pages + 1)
    for level in range(1, 6):
        data += interior(pages + level + 1)
    data += leaf
    struct.pack_into(">I", data, 28, pages + 6)
    path.write_bytes(bytes(data))


def test_a_tree_without_end_is_one_sentence(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schema, "STEPS", 10**6)
    tree_of_itself(store)
    said(store)
    found = recover(store)
    assert len(found.trials) <= 5
    assert len(found.trajectories) == 9


# Anything at all

NAMES = st.sampled_from(["trials", "trajectories", "experiment", "settings", "history", "x", "sqlite_stat1"])
COLUMN = st.sampled_from(["number", "key", "value", "trial", "side", "npz", "checksum", "rowid", "state", "distance"])
KIND = st.sampled_from(["", "INTEGER", "TEXT", "REAL", "BLOB", "INTEGER PRIMARY KEY", "AS (1)", "DEFAULT (random())"])
TABLE = st.builds(
    lambda name, fields: f"CREATE TABLE {name} ({', '.join(f'{c} {k}' for c, k in fields.items())})",
    NAMES,
    st.dictionaries(COLUMN, KIND, min_size=1, max_size=4),
)
STATEMENT = st.one_of(
    TABLE,
    st.builds("CREATE VIEW {} AS {}".format, NAMES, st.just(FOREVER.format("x"))),
    st.builds("DROP TABLE IF EXISTS {}".format, NAMES),
    st.builds("ALTER TABLE {} DROP COLUMN {}".format, NAMES, COLUMN),
    st.builds("ALTER TABLE {} ADD COLUMN {} TEXT".format, NAMES, COLUMN),
    st.builds("CREATE TRIGGER t{0} AFTER INSERT ON {0} BEGIN DELETE FROM {0}; END".format, NAMES),
    st.builds("PRAGMA user_version = {}".format, st.integers(-(2**31), 2**31 - 1) | st.integers(-1, 7)),
    st.builds("PRAGMA application_id = {}".format, st.integers(0, 3)),
    st.builds("UPDATE {} SET {} = {}".format, NAMES, COLUMN, st.sampled_from(["NULL", "x'00'", "'['", "9e999", "-1"])),
    st.builds("INSERT INTO {0} SELECT * FROM {0}".format, NAMES),
    st.just("PRAGMA journal_mode = WAL"),
)


@given(statements=st.lists(STATEMENT, min_size=1, max_size=5))
def test_any_database_is_read_or_refused(whole: Path, statements: list[str]) -> None:
    path = whole.with_name("fuzzed.sqlite")
    for old in path.parent.glob("fuzzed*"):
        old.unlink()
    shutil.copy(whole, path)
    connection = sqlite3.connect(path, isolation_level=None)
    for statement in statements:
        try:
            connection.execute(statement)
        except sqlite3.Error:
            continue
    connection.close()
    for read in (read_everything, recover):
        with suppress(CtxvalError):
            read(path)


def read_everything(path: Path) -> object:
    store = Store.existing(path)
    try:
        known = store.description(), store.settings(), store.signature()
        return known, [store.trajectory(trial.number, "model") for trial in store.trials()]
    finally:
        store.close()
