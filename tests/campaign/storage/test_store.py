from __future__ import annotations

import sqlite3
import tracemalloc
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ctxval import Store, Trajectory, Trial
from ctxval.core.trial import Change
from ctxval.core.trial_note import NO_NOTE, TrialNote
from ctxval.errors import ForeignStoreError, InputError, StoreAccessError
from facts import refuses

TRAJECTORY = Trajectory(np.arange(4.0), np.random.default_rng(0).normal(size=(4, 2)), np.ones((3, 1)))


def trial(number: int = 0) -> Trial:
    point = np.array([1 / 3, np.nextafter(0.5, 1)])
    return Trial(number, "iid", "open", point, {"a": 0.1, "b": [1.0, 2.0]}, attempts=1)


def test_a_trial_comes_back_bit_for_bit(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    store.add([(trial(), TRAJECTORY, None)])
    ended = replace(trial(), state="completed", executed=True, distance=0.1 + 0.2, seconds=1.5)
    store.close_trials([(ended, TRAJECTORY)])
    store.close()
    (back,) = Store(tmp_path / "a.sqlite").trials()
    np.testing.assert_array_equal(back.unit_point, ended.unit_point)
    assert (back.distance, back.origin, back.state, back.parameters) == (
        0.1 + 0.2,
        "iid",
        "completed",
        ended.parameters,
    )
    assert (back.attempts, back.executed, back.failure, back.seconds) == (1, True, None, 1.5)


def test_a_note_comes_back_bit_for_bit_and_none_as_none(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    note = TrialNote({"engine": "climb", "climb": 2, "expected": 0.1 + 0.2, "radius": 1.0, "why": None}, draws=2)
    store.add([(replace(trial(), note=note), TRAJECTORY, None)])
    store.add([(trial(1), TRAJECTORY, None)])
    store.add([(replace(trial(2), state="failed", failure="x", note=note), None, None)])
    store.close()
    assert [t.note for t in Store(tmp_path / "a.sqlite").trials()] == [note, NO_NOTE, note]


def test_trajectories_come_back_bit_for_bit_and_absent_ones_as_none() -> None:
    store = Store()
    store.add([(trial(), TRAJECTORY, None)])
    back = store.trajectory(0, "model")
    assert back is not None
    np.testing.assert_array_equal(back.states, TRAJECTORY.states)
    assert store.trajectory(0, "system") is None


def test_an_ended_trial_cannot_end_again() -> None:
    store = Store()
    store.add([(trial(), TRAJECTORY, None)])
    store.close_trials([(replace(trial(), state="failed", failure="x"), None)])
    with refuses(InputError, 0):
        store.close_trials([(replace(trial(), state="completed", distance=1.0), TRAJECTORY)])
    assert store.trials()[0].state == "failed"


def test_two_writers_of_one_trial_collide_with_a_clear_error(tmp_path: Path) -> None:
    first, second = Store(tmp_path / "a.sqlite"), Store(tmp_path / "a.sqlite")
    first.add([(trial(), TRAJECTORY, None)])
    with refuses(StoreAccessError, "a.sqlite", "trials.number"):
        second.add([(trial(), TRAJECTORY, None)])
    assert len(second.trials()) == 1


def test_the_first_description_stays_until_a_change_is_stated() -> None:
    store = Store()
    assert store.describe_first({"seed": 1}) == {"seed": 1}
    assert store.describe_first({"seed": 2}) == {"seed": 1}
    store.keep_draws(7)
    store.keep_draws(8)
    store.describe_anew({"seed": 2}, Change("accepted", "new battery", {"differences": ["seed"]}))
    assert store.description() == {"seed": 2}
    assert store.draws() == 7
    (change,) = store.history()
    assert (change.what, change.why, change.content) == ("accepted", "new battery", {"differences": ["seed"]})
    assert change.at


def test_a_foreign_database_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "photos.sqlite"
    with sqlite3.connect(path) as other:
        other.execute("CREATE TABLE photos (name TEXT)")
    other.close()
    before = path.read_bytes()
    with refuses(ForeignStoreError, "photos.sqlite"):
        Store(path)
    assert path.read_bytes() == before


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("just some notes, long enough to be read as a page header by anyone who tries. " * 20)
    with refuses(ForeignStoreError, "notes.txt"):
        Store(path)


@pytest.mark.parametrize(("version", "age"), [(99, "a newer"), (7, "an older"), (1, "an older")])
def test_another_schema_is_refused_in_one_sentence(tmp_path: Path, version: int, age: str) -> None:
    path = tmp_path / "a.sqlite"
    Store(path).close()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("DROP TABLE history")
        connection.execute(f"PRAGMA user_version = {version}")
    before = path.read_bytes()
    with refuses(ForeignStoreError, 8, version, age):
        Store(path)
    assert path.read_bytes() == before


def test_an_impossible_path_is_an_access_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with refuses(StoreAccessError, "a.sqlite"):
        Store(tmp_path / "file" / "a.sqlite")
    with refuses(StoreAccessError, "none.sqlite"):
        Store.existing(tmp_path / "none.sqlite")


def test_a_full_disk_loses_nothing_that_was_stored(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    store.add([(trial(), TRAJECTORY, None)])
    pages = store._execute("PRAGMA page_count").fetchone()[0]
    store._execute(f"PRAGMA max_page_count = {pages}")
    big = Trajectory(np.arange(5001.0), np.random.default_rng(1).normal(size=(5001, 4)), np.zeros((5000, 1)))
    with refuses(StoreAccessError, "full", "a.sqlite"):
        store.add([(trial(1), big, None)])
    store.close()
    assert [t.number for t in Store(tmp_path / "a.sqlite").trials()] == [0]


def test_settings_come_back_and_the_last_ones_count(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    assert store.settings() == {}
    store.keep_settings({"experiment": "pendulum", "budget": 5, "old": True})
    kept = {"experiment": "pendulum", "budget": None, "search": {"type": "gp-ucb", "beta": 2.0}}
    store.keep_settings(kept)
    store.close()
    assert Store(tmp_path / "a.sqlite").settings() == kept


def test_settings_that_are_too_long_are_neither_stored_nor_read(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    with refuses(InputError, 16777216, 16777218):
        store.keep_settings({"name": "0" * 2**24})
    assert store.settings() == {}
    with closing(sqlite3.connect(tmp_path / "a.sqlite")) as other, other:
        other.execute("INSERT INTO settings SELECT 'name', '\"' || hex(zeroblob(20000000)) || '\"'")
    tracemalloc.start()
    with refuses(ForeignStoreError, "a.sqlite"):
        store.settings()
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


def test_settings_do_not_change_which_experiment_it_is() -> None:
    store = Store()
    store.describe_first({"seed": 1})
    store.keep_settings({"budget": 5})
    assert store.description() == {"seed": 1}


def test_what_was_computed_is_kept_until_the_content_changes(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    store.add([(trial(), TRAJECTORY, None)])
    digest = store.digest()
    store.keep_computed("verdict", {"bound": np.inf}, digest)
    assert Store(tmp_path / "a.sqlite").computed("verdict") == {"bound": np.inf}
    assert store.computed("other") is None
    store.close_trials([(replace(trial(), state="completed", executed=True, distance=1.0), TRAJECTORY)])
    assert store.computed("verdict") is None
    store.keep_computed("verdict", 1, digest)  # by a process that has not seen the change
    assert store.computed("verdict") is None
    store.keep_computed("verdict", 2, store.digest())
    with closing(sqlite3.connect(tmp_path / "a.sqlite")) as connection:
        assert connection.execute("SELECT value FROM computed").fetchall() == [("2",)]
        connection.execute("UPDATE computed SET value = '{'")
        connection.commit()
    assert store.computed("verdict") is None


@pytest.mark.parametrize(
    "rows",
    [[("a", "1"), ("a", "2")], [(b"a", "1")], [(None, "1")], [("a", b"1")], [("a", "{")], [("a", "[" * 60 + "]" * 60)]],
)
def test_settings_must_be_texts_with_json_each_of_which_occurs_once(rows: list[tuple[object, object]]) -> None:
    store = Store()
    store._execute(
        "CREATE TEMP TABLE settings (key, value)"
    )  # without the constraints of a store, as in a damaged file
    for row in rows:
        store._execute("INSERT INTO temp.settings VALUES (?, ?)", row)
    with refuses(ForeignStoreError, "settings"):
        store.settings()
