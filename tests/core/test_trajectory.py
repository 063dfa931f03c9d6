from __future__ import annotations

import io
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Trajectory, Transitions
from ctxval.errors import InputError, ShapeError
from facts import refuses

ANY = st.floats()
NUMBERS = st.floats(allow_nan=False)


@st.composite
def trajectories(draw: st.DrawFn, elements: st.SearchStrategy[float], batched: bool) -> Trajectory:
    batch = draw(st.sampled_from([(), (1,), (2, 2)])) if batched else ()
    horizon, n, m = draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(0, 2))
    return Trajectory(
        draw(arrays(np.float64, horizon + 1, elements=elements)),
        draw(arrays(np.float64, (*batch, horizon + 1, n), elements=elements)),
        draw(arrays(np.float64, (*batch, horizon, m), elements=elements)),
        draw(st.sampled_from(["complete", "diverged at step 3", "Störung im Rad \U0001f916"])),
    )


def same_bits(a: Trajectory, b: Trajectory) -> bool:
    pairs = [(a.times, b.times), (a.states, b.states), (a.inputs, b.inputs)]
    return all(x.shape == y.shape and x.tobytes() == y.tobytes() for x, y in pairs)


@pytest.fixture
def walk() -> Trajectory:
    rng = np.random.default_rng(0)
    return Trajectory(np.arange(4) * 0.1, rng.normal(size=(4, 2)), rng.normal(size=(3, 1)))


@pytest.fixture
def batch() -> Trajectory:
    rng = np.random.default_rng(1)
    return Trajectory(np.arange(4) * 0.1, rng.normal(size=(5, 4, 2)), rng.normal(size=(5, 3, 1)))


# What a trajectory is


@pytest.mark.parametrize(
    ("times", "states", "inputs"),
    [
        ((4,), (3, 2), (3, 1)),
        ((4,), (4, 2), (4, 1)),
        ((4,), (4,), (3,)),
        ((4,), (4, 2), (3,)),
        ((4, 1), (4, 2), (3, 1)),
        ((4,), (5, 4, 2), (6, 3, 1)),
        ((4,), (5, 4, 2), (3, 1)),
    ],
)
def test_arrays_that_do_not_fit_are_refused_with_all_shapes(
    times: tuple[int, ...], states: tuple[int, ...], inputs: tuple[int, ...]
) -> None:
    with pytest.raises(ShapeError) as caught:
        Trajectory(np.zeros(times), np.zeros(states), np.zeros(inputs))
    assert f"got {times}, {states} and {inputs}" in str(caught.value)


def test_what_is_no_number_is_refused() -> None:
    with refuses(InputError, "states", "b"):
        Trajectory([0.0, 1.0], [["a"], ["b"]], [[0.0]])


def test_lists_become_arrays_with_the_derived_sizes() -> None:
    one = Trajectory([0, 1, 2], [[1, 2], [3, 4], [5, 6]], [[7], [8]])
    assert (one.horizon, one.batch_shape, one.final_state.tolist(), one.ended) == (2, (), [5.0, 6.0], "complete")


def test_a_batch_is_indexed_along_its_first_axis(batch: Trajectory) -> None:
    assert batch.batch_shape == (5,)
    np.testing.assert_array_equal(batch.final_state, batch.states[:, -1])
    np.testing.assert_array_equal(batch[3].states, batch.states[3])
    np.testing.assert_array_equal(batch[3].inputs, batch.inputs[3])
    np.testing.assert_array_equal(batch[-1].final_state, batch.final_state[-1])


def test_a_batch_of_batches_is_indexed_one_axis_at_a_time() -> None:
    states = np.random.default_rng(0).normal(size=(2, 3, 4, 2))
    nested = Trajectory(np.arange(4), states, np.zeros((2, 3, 3, 1)))
    np.testing.assert_array_equal(nested[1][2].states, states[1, 2])


def test_finiteness_is_told_for_each_task(batch: Trajectory) -> None:
    states, inputs = batch.states.copy(), batch.inputs.copy()
    states[1, 2, 0], inputs[3, 0, 0] = np.nan, np.inf
    broken = Trajectory(batch.times, states, inputs)
    assert broken.finite.tolist() == [True, False, True, False, True]
    assert batch[0].finite.shape == ()
    assert bool(batch[0].finite)


# Transitions


def test_a_transition_joins_each_state_with_the_input_and_the_next_state(walk: Trajectory) -> None:
    steps = walk.transitions()
    assert len(steps) == 3
    np.testing.assert_array_equal(steps.x, walk.states[:-1])
    np.testing.assert_array_equal(steps.u, walk.inputs)
    np.testing.assert_array_equal(steps.x_next, walk.states[1:])


def test_the_transitions_of_a_batch_are_those_of_its_tasks_in_turn(batch: Trajectory) -> None:
    whole, joined = batch.transitions(), Transitions.joined([batch[i].transitions() for i in range(5)])
    assert len(whole) == 15
    for name in ("x", "u", "x_next"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(joined, name))


@pytest.mark.parametrize(
    ("x", "u", "x_next"),
    [((3, 2), (2, 1), (3, 2)), ((3, 2), (3, 1), (3, 1)), ((3,), (3, 1), (3,)), ((3, 2), (3,), (3, 2))],
)
def test_transitions_that_do_not_fit_are_refused_with_all_shapes(
    x: tuple[int, ...], u: tuple[int, ...], x_next: tuple[int, ...]
) -> None:
    with pytest.raises(ShapeError) as caught:
        Transitions(np.zeros(x), np.zeros(u), np.zeros(x_next))
    assert f"got {x}, {u} and {x_next}" in str(caught.value)


# NPZ


@given(trajectories(ANY, batched=True))
def test_npz_gives_back_every_bit(trajectory: Trajectory) -> None:
    again = Trajectory.from_npz(trajectory.to_npz())
    assert same_bits(again, trajectory)
    assert again.ended == trajectory.ended


def test_npz_is_read_from_a_file_too(walk: Trajectory, tmp_path: Path) -> None:
    (tmp_path / "walk.npz").write_bytes(walk.to_npz())
    for source in (tmp_path / "walk.npz", str(tmp_path / "walk.npz")):
        assert same_bits(Trajectory.from_npz(source), walk)


def test_npz_without_an_ending_is_a_complete_trajectory(walk: Trajectory) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, times=walk.times, states=walk.states, inputs=walk.inputs)
    assert Trajectory.from_npz(buffer.getvalue()).ended == "complete"


class Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return pytest.fail, ("a pickle was executed",)


def test_a_pickle_inside_an_npz_is_refused_and_never_run(walk: Trajectory) -> None:
    for name in ("times", "states", "inputs", "ended"):
        content = {"times": walk.times, "states": walk.states, "inputs": walk.inputs, "ended": np.array("complete")}
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=True, **{**content, name: np.array([Bomb()], dtype=object)})
        with refuses(InputError, "NPZ"):
            Trajectory.from_npz(buffer.getvalue())


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@pytest.mark.parametrize("source", [b"", b"PK\x03\x04", b"\x80\x04.", b"\x93NUMPY", b"t,x0\n0,1\n", npy(np.zeros(3))])
def test_bytes_that_are_no_npz_are_refused(source: bytes) -> None:
    with refuses(InputError, "NPZ"):
        Trajectory.from_npz(source)


@given(st.binary(max_size=200))
def test_random_bytes_are_refused(source: bytes) -> None:
    with pytest.raises(InputError):
        Trajectory.from_npz(source)


def test_damaged_npz_is_read_or_refused_and_nothing_else(walk: Trajectory) -> None:
    rng, whole, refused = random.Random(0), walk.to_npz(), 0
    for _ in range(400):
        damaged = bytearray(whole)
        for _ in range(rng.choice([1, 3])):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        try:
            Trajectory.from_npz(bytes(damaged[: rng.choice([None, rng.randrange(len(damaged))])]))
        except InputError:
            refused += 1
    assert refused > 300


@pytest.mark.parametrize("missing", ["times", "states", "inputs"])
def test_npz_without_an_array_is_refused(walk: Trajectory, missing: str) -> None:
    content = {name: getattr(walk, name) for name in ("times", "states", "inputs") if name != missing}
    buffer = io.BytesIO()
    np.savez(buffer, **content)
    with refuses(InputError, "times"):
        Trajectory.from_npz(buffer.getvalue())


def test_npz_whose_arrays_do_not_fit_says_so(walk: Trajectory) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, times=walk.times, states=walk.states[:2], inputs=walk.inputs)
    with refuses(ShapeError, (4,), (2, 2), (3, 1)):
        Trajectory.from_npz(buffer.getvalue())


def test_a_missing_npz_is_refused_by_name(tmp_path: Path) -> None:
    with refuses(InputError, "nothing.npz"):
        Trajectory.from_npz(tmp_path / "nothing.npz")


@pytest.mark.parametrize("name", ["times", "states", "inputs"])
def test_a_masked_array_is_no_part_of_a_trajectory(walk: Trajectory, name: str) -> None:
    content = {part: getattr(walk, part) for part in ("times", "states", "inputs")}
    content[name] = np.ma.masked_array(
        content[name], mask=np.arange(content[name].size).reshape(content[name].shape) == 1
    )
    with refuses(InputError, name):
        Trajectory(**content)


def test_npz_of_another_shape_than_a_plan_has_is_refused(walk: Trajectory) -> None:
    assert same_bits(Trajectory.from_npz(walk.to_npz(), shape=walk.states.shape), walk)  # type: ignore[arg-type]
    with refuses(ShapeError, "shape", (9, 2), (4, 2)):
        Trajectory.from_npz(walk.to_npz(), shape=(9, 2))
    # One that stopped early says why, however short it is.
    short = Trajectory(walk.times, walk.states, walk.inputs, ended="operator stop")
    assert Trajectory.from_npz(short.to_npz(), shape=(9, 2)).ended == "operator stop"


# CSV


@given(trajectory=trajectories(NUMBERS, batched=False))
def test_csv_gives_back_every_bit(trajectory: Trajectory, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("csv") / "one.csv"
    trajectory.to_csv(path)
    assert same_bits(Trajectory.from_csv(path), trajectory)


def test_csv_keeps_what_is_not_a_number(tmp_path: Path) -> None:
    Trajectory([0, 1], [[np.nan], [-np.inf]], [[np.nan]]).to_csv(tmp_path / "one.csv")
    again = Trajectory.from_csv(tmp_path / "one.csv")
    np.testing.assert_array_equal(again.states, [[np.nan], [-np.inf]])
    np.testing.assert_array_equal(again.inputs, [[np.nan]])


def test_csv_has_named_columns_and_a_last_row_without_inputs(tmp_path: Path) -> None:
    Trajectory([0, 0.5], [[1, 2], [3, 4]], [[-5]]).to_csv(tmp_path / "one.csv")
    assert (tmp_path / "one.csv").read_text().splitlines() == ["t,x0,x1,u0", "0.0,1.0,2.0,-5.0", "0.5,3.0,4.0,"]


def test_csv_columns_are_found_by_name_and_others_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "rig.csv"
    path.write_text("note,u0,x1,t,x0\nstart,9,2,0,1\nend,,4,1,3\n")
    again = Trajectory.from_csv(path)
    assert again.states.tolist() == [[1, 2], [3, 4]]
    assert again.inputs.tolist() == [[9]]
    assert again.times.tolist() == [0, 1]


def test_csv_keeps_names_with_an_index(tmp_path: Path) -> None:
    run = Trajectory(0.1 * np.arange(3), np.arange(6.0).reshape(3, 2), np.ones((2, 1)))
    for units in ("", " [m]"):
        names = [f"q[1]{units}", f"q[2]{units}"]
        run.to_csv(tmp_path / "run.csv", states=names, inputs=["u[1]"])
        again = Trajectory.from_csv(tmp_path / "run.csv", states=names, inputs=["u[1]"])
        np.testing.assert_array_equal(again.states, run.states)


def test_a_batch_is_refused_as_csv(batch: Trajectory, tmp_path: Path) -> None:
    with refuses(ShapeError, (5,), "file"):
        batch.to_csv(tmp_path / "batch.csv")


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("t,x0,u0\n0,1,2\n1,one,\n", ("rig.csv", 3, "x0")),
        ("t,x0,u0\n0,1,\n1,2,\n", ("rig.csv", 2, "u0")),
        ("t,x0,u0\nnoon,1,2\n1,2,\n", ("rig.csv", 2, "t")),
        ("t,x0,u0\n0,1,2\n1\n", ("rig.csv", 3, "x0")),
        ("x0,u0\n1,2\n3,\n", ("rig.csv",)),
        ("t,u0\n0,2\n1,\n", ("rig.csv",)),
        ("t,x0,u0\n0,1,2\n", ("rig.csv",)),
        ("", ("rig.csv",)),
    ],
)
def test_unusable_csv_is_refused_with_line_and_column(tmp_path: Path, text: str, facts: tuple[object, ...]) -> None:
    (tmp_path / "rig.csv").write_text(text)
    with refuses(InputError, *facts):
        Trajectory.from_csv(tmp_path / "rig.csv")


def test_a_file_that_is_no_text_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "rig.csv").write_bytes(b"t,x0\n\x81\x8d,1\n")
    with refuses(InputError, "rig.csv", "charmap"):
        Trajectory.from_csv(tmp_path / "rig.csv")
    with refuses(InputError, "nothing.csv"):
        Trajectory.from_csv(tmp_path / "nothing.csv")


def test_recorded_steps_of_different_sizes_are_not_joined() -> None:
    small, large = (Transitions(np.ones((4, n)), np.ones((4, 1)), np.ones((4, n))) for n in (2, 3))
    with refuses(ShapeError, 2, 1, 3):
        Transitions.joined([small, large])


def test_a_gap_and_times_that_do_not_increase_are_not_resampled_over() -> None:
    times = np.arange(0.0, 3.001, 0.01)
    wanted = 0.05 * np.arange(41)  # the task ends at 2 s

    def recorded(rows: np.ndarray) -> Trajectory:
        return Trajectory(times[rows], np.sin(times[rows])[:, None], np.ones((len(rows) - 1, 1)))

    rows = np.arange(len(times))
    few, after = np.delete(rows, slice(50, 60)), np.delete(rows, slice(210, 290))
    for kept in (rows, few, after):
        np.testing.assert_allclose(recorded(kept).resampled(wanted).states[:, 0], np.sin(wanted), atol=2e-3)
    with refuses(InputError, 1.01, 0.49):
        recorded(np.delete(rows, slice(50, 150))).resampled(wanted)
    for twice in (8, 1, len(rows)):
        again = recorded(np.insert(rows, twice, rows[twice - 1])).resampled(wanted)
        np.testing.assert_array_equal(again.states, recorded(rows).resampled(wanted).states)
        np.testing.assert_array_equal(again.inputs, recorded(rows).resampled(wanted).inputs)
    contradicting = recorded(np.insert(rows, 8, 7))
    contradicting.states[8] += 0.1
    with refuses(InputError, "times", 8, 0.07):
        contradicting.resampled(wanted)
