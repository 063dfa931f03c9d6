"""What a row must be to be a trial."""

from __future__ import annotations

import json
import tempfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ctxval import Store, Trajectory, Trial
from ctxval.campaign.storage.rows import COLUMNS, Side, checksum_of, follows, read_json, read_trial, row_of
from ctxval.core.trial_note import TrialNote
from ctxval.errors import ForeignStoreError, InputError
from facts import refuses

NAMES = [name.strip() for name in COLUMNS.split(",")]
WHOLE = Trial(
    *(0, "iid", "completed", np.array([0.25, 1.0]), {"a": 1.5, "b": [1.0, -2.0]}, 1, True, 0.5),
    *(None, 2.0, TrialNote({"engine": "climb", "expected": 0.5})),
)


def read(row: tuple[Any, ...]) -> Trial | None:
    """Read a row of which the checksum fits, as anybody can compute one."""
    with suppress(InputError):
        return read_trial(row, checksum_of(row))
    return None


def changed(**values: Any) -> tuple[Any, ...]:
    row = dict(zip(NAMES, row_of(WHOLE), strict=True))
    return tuple((row | values).values())


def test_a_whole_row_is_read() -> None:
    trial = read(row_of(WHOLE))
    assert trial is not None
    assert (trial.parameters, trial.distance, trial.note) == (WHOLE.parameters, 0.5, WHOLE.note)
    assert read(changed(state="failed", distance=None, failure="it broke", seconds=None, note=None)) is not None
    assert read(changed(state="open", distance=None, executed=0)) is not None


@pytest.mark.parametrize(
    "values",
    [
        {"distance": np.inf},
        {"distance": -np.inf},
        {"distance": np.nan},
        {"distance": -0.5},
        {"distance": "0.5"},
        {"distance": b"0.5"},
        {"distance": 1},
        {"state": "failed"},
        {"distance": None},
        {"state": "open", "distance": None},
        {"state": "done"},
        {"state": b"completed"},
        {"origin": "guessed"},
        {"origin": None},
        {"attempts": -1},
        {"attempts": "1" + "0" * 300},
        {"attempts": 1.5},
        {"attempts": 2**60},
        {"number": -1},
        {"number": "0"},
        {"number": 0.0},
        {"executed": 2},
        {"executed": "yes"},
        {"seconds": -1.0},
        {"seconds": np.inf},
        {"seconds": np.nan},
        {"seconds": "long"},
        {"failure": b"bytes"},
        {"failure": 3},
        {"unit_point": "[1.5, 0.5]"},
        {"unit_point": "[-1e-9]"},
        {"unit_point": "[NaN]"},
        {"unit_point": "[Infinity]"},
        {"unit_point": "[]"},
        {"unit_point": "0.5"},
        {"unit_point": "[[0.5]]"},
        {"unit_point": '["0.5"]'},
        {"unit_point": "[true]"},
        {"unit_point": '{"0": 0.5}'},
        {"unit_point": b"[0.5]"},
        {"unit_point": None},
        {"unit_point": "[0.5"},
        {"unit_point": "[" * 100_000},
        {"parameters": "[1.0]"},
        {"parameters": "null"},
        {"parameters": '"goal"'},
        {"parameters": '{"a": true}'},
        {"parameters": '{"a": NaN}'},
        {"parameters": '{"a": 1' + "0" * 400 + "}"},
        {"parameters": '{"a": {"b": 1.0}}'},
        {"parameters": '{"a": ' + "[" * 500 + "]" * 500 + "}"},
        {"parameters": '{"a": ' + "[" * 100_000 + "]" * 100_000 + "}"},
        {"state": "unmeasured"},
        {"state": "unmeasured", "distance": None, "executed": 0},
        {"because": b"bytes"},
        {"because": 3},
        {"note": "[1]"},
        {"note": "{"},
        {"note": 3},
    ],
)
def test_a_row_that_no_trial_has_is_damaged(values: dict[str, Any]) -> None:
    assert read(changed(**values)) is None


def test_a_row_needs_its_checksum() -> None:
    row = row_of(WHOLE)
    for checksum in (None, checksum_of(row) + 1):
        with pytest.raises(InputError):
            read_trial(row, checksum)


ANYTHING = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.text(st.characters(exclude_categories=["Cs"])),
    st.binary(),
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    ).map(json.dumps),
)


@given(st.dictionaries(st.sampled_from(NAMES), ANYTHING, max_size=4))
@example(dict.fromkeys(NAMES))
def test_any_row_is_a_trial_that_can_be_or_none(values: dict[str, Any]) -> None:
    trial = read(changed(**values))
    if trial is None:
        return
    assert trial.unit_point.ndim == 1
    assert ((trial.unit_point >= 0) & (trial.unit_point <= 1)).all()
    assert (trial.distance is not None) == (trial.state == "completed")
    assert trial.distance is None or 0 <= trial.distance < np.inf
    assert isinstance(trial.failure, str | None)
    json.dumps(trial.parameters, allow_nan=False)


def test_a_trial_follows_those_of_its_space() -> None:
    other = Trial(1, "iid", "open", np.array([0.5]), {"a": 1.0})
    assert follows(WHOLE, [])
    assert not follows(other, [])
    assert not follows(other, [WHOLE])
    assert follows(Trial(1, "iid", "open", np.array([0.5, 0.5]), {}), [WHOLE])


def test_json_is_json() -> None:
    assert read_json("[1, null]") == [1, None]
    assert np.isnan(read_json("NaN", finite=False))
    with refuses(InputError, "NaN"):
        read_json("NaN")


# Trajectories


def trajectory(seed: int, steps: int = 3) -> Trajectory:
    states = np.random.default_rng(seed).normal(size=(steps + 1, 2))
    return Trajectory(np.arange(steps + 1.0), states, np.ones((steps, 1)))


def add(store: Store, number: int, system: Trajectory | None) -> None:
    trial = Trial(number, "manual", "completed", np.array([0.5]), {"a": 0.5}, executed=True, distance=1.0)
    store.add([(trial, trajectory(0), system)])


def reads_of(store: Store, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list to which each trajectory that is read from the file adds its number."""
    numbers: list[int] = []
    read = store._read_trajectory

    def counted(number: int, side: str) -> object:
        numbers.append(number)
        return read(number, side)  # type: ignore[arg-type]

    monkeypatch.setattr(store, "_read_trajectory", counted)
    return numbers


def test_a_trajectory_is_read_from_the_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path / "a.sqlite")
    for number in range(3):
        add(store, number, None if number == 1 else trajectory(number))
    reads = reads_of(store, monkeypatch)
    first = store.trajectories(range(3), "system")
    add(store, 3, trajectory(3))
    second = store.trajectories(range(4), "system")
    assert (list(first), list(second), reads) == ([0, 2], [0, 2, 3], [0, 1, 2, 3])
    assert second[2] is first[2]
    np.testing.assert_array_equal(second[3].states, trajectory(3).states)


def test_a_trajectory_in_memory_cannot_be_changed(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    add(store, 0, trajectory(0))
    found = store.trajectories([0], "system")[0]
    with refuses(ValueError):
        found.states[0] = 7.0


@pytest.mark.parametrize("side", ["model", "system"])
def test_a_single_trajectory_belongs_to_the_caller(side: Side) -> None:
    store = Store()
    add(store, 0, trajectory(0))
    for _ in range(2):
        found = store.trajectory(0, side)
        assert found is not None
        np.testing.assert_array_equal(found.states, trajectory(0).states)
        found.states[:] = found.inputs[:] = 7.0


def test_trajectories_of_the_model_are_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path / "a.sqlite")
    add(store, 0, trajectory(0))
    reads = reads_of(store, monkeypatch)
    assert store.trajectory(0, "model") is not None
    assert store.trajectory(0, "model") is not None
    assert reads == [0, 0]


def test_what_another_process_stores_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, other = Store(tmp_path / "a.sqlite"), Store(tmp_path / "a.sqlite")
    add(store, 0, trajectory(0))
    opened = Trial(1, "manual", "open", np.array([0.2]), {"a": 0.2})
    store.add([(opened, trajectory(0), None)])
    reads = reads_of(store, monkeypatch)
    assert list(store.trajectories([0, 1], "system")) == [0]
    other.close_trials([(replace(opened, state="completed", executed=True, distance=1.0), trajectory(1))])
    assert list(store.trajectories([0, 1], "system")) == [0, 1]
    assert reads == [0, 1, 1]  # the first one is the same as before


def test_a_row_that_was_repaired_is_read_again_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    store, other = Store(tmp_path / "a.sqlite"), Store(tmp_path / "a.sqlite")
    for number in range(2):
        add(store, number, trajectory(number))
    store.trajectories([0, 1], "system")
    npz = trajectory(7).to_npz()
    with other._transaction():
        change = "UPDATE trajectories SET npz = ?, checksum = ? WHERE trial = ? AND side = 'system'"
        other._execute(change, (npz, checksum_of((0, "system", npz)), 0))
    np.testing.assert_array_equal(store.trajectories([0, 1], "system")[0].states, trajectory(7).states)
    with other._transaction():
        other._execute(change, (npz, 1, 1))
    with refuses(ForeignStoreError, 1, "a.sqlite"):
        store.trajectories([0, 1], "system")


def test_memory_is_bounded(tmp_path: Path) -> None:
    one = trajectory(0, steps=100)
    size = one.times.nbytes + one.states.nbytes + one.inputs.nbytes
    stored = Store(tmp_path / "a.sqlite")
    stored._memory = 3 * size
    store = Store(tmp_path / "a.sqlite")
    for number in range(5):
        add(store, number, trajectory(number, steps=100))
    found = stored.trajectories(range(5), "system")
    again = stored.trajectories(range(5), "system")
    assert [again[number] is found[number] for number in range(5)] == [True] * 3 + [False] * 2
    for number in range(5):
        np.testing.assert_array_equal(again[number].states, trajectory(number, steps=100).states)


@pytest.mark.slow
@given(st.lists(st.tuples(st.integers(0, 1), st.booleans(), st.booleans()), max_size=12))
def test_a_store_with_memory_reads_what_a_new_one_reads(steps: list[tuple[int, bool, bool]]) -> None:
    """Two connections add trials in any order; either may have read in between."""
    with tempfile.TemporaryDirectory() as folder:
        stores = [Store(Path(folder) / "a.sqlite") for _ in range(2)]
        for number, (writer, has_trajectory, reads) in enumerate(steps):
            add(stores[writer], number, trajectory(number) if has_trajectory else None)
            if reads:
                stores[1 - writer].trajectories(range(number + 1), "system")
        new = Store(Path(folder) / "a.sqlite")
        expected = new.trajectories(range(len(steps)), "system")
        for store in stores:
            found = store.trajectories(range(len(steps)), "system")
            assert list(found) == list(expected)
            for number, one in expected.items():
                np.testing.assert_array_equal(found[number].states, one.states)
        for store in [*stores, new]:
            store.close()
