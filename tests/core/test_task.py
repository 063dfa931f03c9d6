from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays, mutually_broadcastable_shapes

from ctxval import Task
from ctxval.errors import InputError, ShapeError
from facts import assert_names, refuses

FINITE = st.floats(-1e6, 1e6)


def task(initial_state: object = (1.0, 2.0), horizon: object = 3, dt: object = 0.1, **target: object) -> Task:
    return Task(initial_state, horizon=horizon, dt=dt, **target)


@given(mutually_broadcastable_shapes(num_shapes=4, max_dims=2, max_side=3), st.data())
def test_components_broadcast_as_numpy_does(shapes: object, data: st.DataObject) -> None:
    parts = [data.draw(arrays(np.float64, shape, elements=FINITE)) for shape in shapes.input_shapes]
    one = task(initial_state=parts[:2], goal=parts[2:])
    assert one.batch_shape == shapes.result_shape
    for k in range(2):
        np.testing.assert_array_equal(one.initial_state[..., k], np.broadcast_to(parts[k], one.batch_shape))
        np.testing.assert_array_equal(one.goal[..., k], np.broadcast_to(parts[2 + k], one.batch_shape))
    assert one.reference.shape == (*one.batch_shape, 4, 2)


def test_one_function_makes_one_task_or_a_thousand() -> None:
    def regulate(goal: object) -> Task:
        return task(initial_state=[np.pi, 0.0], goal=[goal, 0.0])

    goals = np.linspace(-1, 1, 5)
    batch = regulate(goals)
    for i, goal in enumerate(goals):
        np.testing.assert_array_equal(batch[i].initial_state, regulate(goal).initial_state)
        np.testing.assert_array_equal(batch[i].reference, regulate(goal).reference)


def test_a_goal_is_a_constant_reference() -> None:
    regulate = task(goal=(3.0, 4.0))
    np.testing.assert_array_equal(regulate.reference, [[3, 4]] * 4)
    np.testing.assert_array_equal(regulate.goal, [3, 4])


def test_the_goal_of_a_reference_is_its_last_state() -> None:
    reference = np.arange(8.0).reshape(4, 2)
    np.testing.assert_array_equal(task(reference=reference).goal, [6, 7])
    np.testing.assert_array_equal(task(reference=reference).reference, reference)


def test_a_task_without_a_target_goes_to_zero() -> None:
    np.testing.assert_array_equal(task().reference, np.zeros((4, 2)))


def test_an_array_of_initial_states_is_a_batch_along_its_first_axes() -> None:
    states = np.arange(12.0).reshape(2, 3, 2)
    assert task(initial_state=states).batch_shape == (2, 3)
    np.testing.assert_array_equal(task(initial_state=states)[1][2].initial_state, states[1, 2])


def test_a_batch_of_references_serves_one_initial_state() -> None:
    reference = np.random.default_rng(0).normal(size=(5, 4, 2))
    batch = task(reference=reference)
    assert batch.batch_shape == (5,)
    np.testing.assert_array_equal(batch.initial_state, [[1, 2]] * 5)
    np.testing.assert_array_equal(batch[3].reference, reference[3])


def test_times_are_the_multiples_of_the_step() -> None:
    np.testing.assert_allclose(task(horizon=3, dt=0.1).times, [0, 0.1, 0.2, 0.3], rtol=1e-15)
    assert task(horizon=np.int64(7), dt=np.float32(0.5)).times.shape == (8,)


def test_a_task_shows_its_sizes() -> None:
    assert repr(task(goal=[np.zeros(3), 0])) == "Task(batch=(3,), states=2, horizon=3, dt=0.1)"


@pytest.mark.parametrize("horizon", [0, -1, 2.0, "3", None, True])
def test_a_horizon_that_is_no_positive_integer_is_refused_by_value(horizon: object) -> None:
    with refuses(InputError, "horizon", horizon):
        task(horizon=horizon)


@pytest.mark.parametrize("dt", [0, -0.1, np.nan, np.inf, "0.1", None])
def test_a_step_that_is_no_positive_number_is_refused_by_value(dt: object) -> None:
    with refuses(InputError, "dt", dt):
        task(dt=dt)


def test_a_goal_and_a_reference_together_are_refused() -> None:
    with refuses(InputError, "goal", "reference"):
        task(goal=(0, 0), reference=np.zeros((4, 2)))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_refused(bad: float) -> None:
    for values in ({"initial_state": [bad, 0]}, {"goal": [bad, 0]}, {"reference": np.full((4, 2), bad)}):
        with refuses(InputError, "initial_state", "goal", "reference"):
            task(**values)


@pytest.mark.parametrize("value", [1.0, [], np.zeros((0, 2))])
def test_an_initial_state_without_components_is_refused(value: object) -> None:
    with refuses(ShapeError, "initial_state"):
        task(initial_state=value)


def test_a_component_that_is_no_number_is_refused_by_its_place() -> None:
    with refuses(InputError, "goal[1]", "left"):
        task(goal=[0, "left"])


@pytest.mark.parametrize("aim", [{"goal": [0, 0, 0]}, {"reference": np.zeros((4, 3))}])
def test_a_goal_or_reference_of_another_width_is_refused_with_both(aim: dict[str, object]) -> None:
    other = task(**aim)
    other.require_width(3)
    with refuses(ShapeError, "task", 2, "initial_state"):
        other.require_width(2)


@pytest.mark.parametrize("shape", [(3, 2), (3, 3), (4,), (2,)])
def test_a_reference_of_another_shape_is_refused_with_both_shapes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError) as caught:
        task(reference=np.zeros(shape))
    assert_names(str(caught.value), "reference", "shape", shape)


def test_components_of_different_batches_are_refused_with_their_shapes() -> None:
    with refuses(ShapeError, "goal", (2,), (3,)):
        task(goal=[np.zeros(2), np.zeros(3)])


def test_a_goal_of_another_batch_than_the_initial_state_is_refused_with_both_shapes() -> None:
    with refuses(ShapeError, (3,), (2,)):
        task(initial_state=[np.zeros(2), 0], goal=[np.zeros(3), 0])


def test_the_environment_follows_the_task_through_batches() -> None:
    ox = np.array([0.1, 0.2, 0.3])
    batch = task(environment={"obstacle": [ox, 0.5], "wind": [1.0]})
    assert batch.batch_shape == (3,)
    np.testing.assert_array_equal(batch.environment["wind"], np.ones((3, 1)))
    np.testing.assert_array_equal(batch[1].environment["obstacle"], [0.2, 0.5])
    again = Task.stacked([batch[0], batch[1], batch[2]]).named("x")
    np.testing.assert_array_equal(again.environment["obstacle"], batch.environment["obstacle"])
    assert again.starting_at(np.zeros((4, 3, 2))).environment["obstacle"].shape == (4, 3, 2)
    assert "environment" not in task().describe()
    assert list(batch[0].describe()["environment"]) == ["obstacle", "wind"]


def test_an_environment_that_cannot_be_is_refused() -> None:
    with refuses(ShapeError, "environment", (), (3,)):
        task(initial_state=[np.zeros(2), 0], environment={"wall": [np.zeros(3)]})
    with refuses(InputError, "environment", "wall"):
        task(environment={"wall": [np.nan]})


def test_a_command_is_an_entry_of_the_environment() -> None:
    tasks = Task([np.zeros(3), 1.0], horizon=4, dt=0.1, command=[np.array([0.1, 0.2, 0.3]), 0.0, -1.0, 2.0])
    assert tasks.command.shape == (3, 4)
    assert tasks[1].command.tolist() == [0.2, 0.0, -1.0, 2.0]
    assert Task.stacked([tasks[0], tasks[2]]).command[1, 0] == 0.3
    assert np.array_equal(tasks.starting_at(np.ones((3, 2))).command, tasks.command)
    with refuses(InputError, "command"):
        _ = Task([0.0], horizon=4, dt=0.1).command
    with refuses(InputError, "one command"):
        Task([0.0], horizon=4, dt=0.1, command=[1.0], environment={"command": [2.0]})
