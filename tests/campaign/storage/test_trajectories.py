from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Store, Trajectory, Trial
from ctxval.campaign.storage.rows import Side, checksum_of
from ctxval.errors import ForeignStoreError


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
    with pytest.raises(ValueError, match="read-only"):
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
    other.close_trial(replace(opened, state="completed", executed=True, distance=1.0), trajectory(1))
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
    with pytest.raises(ForeignStoreError, match="trial 1 cannot be read"):
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
