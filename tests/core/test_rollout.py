from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ctxval import Task
from ctxval.core.controller import AffineFeedback
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear
from ctxval.systems import Simulated
from ctxval.systems.functions import rk4
from facts import assert_names, refuses


def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.stack([x[..., 1], 14.7 * np.sin(x[..., 0]) + 3 * u[..., 0]], axis=-1)


PENDULUM = rk4(derivative, 0.05)


def damp(t: int, x: np.ndarray) -> np.ndarray:
    return -2 * x[..., :1] - x[..., 1:] + 0.1 * t


def zero(t: int, x: np.ndarray) -> np.ndarray:
    return np.zeros((*x.shape[:-1], 1))


@pytest.mark.parametrize("seed", range(3))
def test_a_linear_closed_loop_is_the_power_of_its_matrix(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = Linear(0.4 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=3))
    K, horizon = 0.2 * rng.normal(size=(2, 3)), 20
    controller = AffineFeedback(np.tile(K, (horizon, 1, 1)), np.zeros((horizon, 2)), np.zeros((horizon, 3)))
    task = Task(rng.normal(size=3), horizon=horizon, dt=0.1)
    loop = rollout(model.step, controller, task)
    closed = model.A + model.B @ K
    rest = np.linalg.solve(np.eye(3) - closed, model.c)
    powers = [np.linalg.matrix_power(closed, t) for t in range(horizon + 1)]
    states = np.array([rest + power @ (task.initial_state - rest) for power in powers])
    np.testing.assert_allclose(loop.states, states, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(loop.inputs, states[:-1] @ K.T, rtol=1e-9, atol=1e-10)
    np.testing.assert_array_equal(loop.times, task.times)
    assert loop.ended == "complete"


@pytest.mark.parametrize("batch", [(1,), (7,), (2, 3)])
def test_a_batch_of_loops_is_the_loop_over_them(batch: tuple[int, ...]) -> None:
    starts = np.random.default_rng(0).normal(size=(*batch, 2))
    whole = rollout(PENDULUM, damp, Task(starts, horizon=30, dt=0.05))
    assert whole.batch_shape == batch
    for i in np.ndindex(batch):
        alone = rollout(PENDULUM, damp, Task(starts[i], horizon=30, dt=0.05))
        np.testing.assert_allclose(whole.states[i], alone.states, rtol=0, atol=1e-10)
        np.testing.assert_allclose(whole.inputs[i], alone.inputs, rtol=0, atol=1e-10)


def test_the_controller_is_asked_once_for_each_step_with_the_state_then() -> None:
    asked = []

    def record(t: int, x: np.ndarray) -> np.ndarray:
        asked.append((t, x.tolist()))
        return np.array([1.0])

    loop = rollout(lambda x, u: x + u, record, Task([5.0], horizon=3, dt=0.1))
    assert asked == [(0, [5.0]), (1, [6.0]), (2, [7.0])]
    assert loop.states.tolist() == [[5], [6], [7], [8]]


def test_the_task_is_left_alone_by_a_step_that_works_in_place() -> None:
    def in_place(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        x += 1
        return x

    task = Task([0.0], horizon=3, dt=0.1)
    assert rollout(in_place, zero, task).states.tolist() == [[0], [1], [2], [3]]
    assert task.initial_state.tolist() == [0]


def test_the_divergence_of_one_task_leaves_the_others_alone() -> None:
    task = Task([[0.5, 1e3, -0.5]], horizon=20, dt=0.1)
    loop = rollout(lambda x, u: x**3 + u, zero, task)
    assert loop.finite.tolist() == [True, False, True]
    for i in (0, 2):
        alone = rollout(lambda x, u: x**3 + u, zero, task[i])
        np.testing.assert_array_equal(loop.states[i], alone.states)
        assert alone.ended == "complete"


def test_a_loop_that_diverges_says_at_which_step() -> None:
    blow_up = rollout(lambda x, u: np.where(x < 3, x + 1, np.nan), zero, Task([0.0], horizon=9, dt=0.1))
    assert_names(blow_up.ended, 4)
    assert np.isfinite(blow_up.states[:4]).all()
    assert not blow_up.finite


def test_an_input_that_is_not_finite_is_told_as_such() -> None:
    loop = rollout(lambda x, u: x, lambda t, x: np.array([np.nan]), Task([0.0], horizon=2, dt=0.1))
    assert_names(loop.ended, "NaN", 0)
    assert not loop.finite
    late = rollout(
        lambda x, u: x + u, lambda t, x: np.where(x < 2, 1.0, np.nan) + 0 * x, Task([0.0], horizon=9, dt=0.1)
    )
    assert_names(late.ended, "NaN", 2)
    rollout(lambda x, u: x, lambda t, x: np.array([np.inf]), Task([0.0], horizon=2, dt=0.1))


@pytest.mark.parametrize(
    ("output", "shape"),
    [(0.0, "()"), (np.zeros((3, 2)), "(3, 2)"), (np.zeros((2, 1)), "(2, 1)"), (np.zeros(4), "(4,)")],
)
def test_a_first_input_of_the_wrong_shape_is_refused_with_both_shapes(output: object, shape: str) -> None:
    task = Task([np.zeros(4), 0.0], horizon=2, dt=0.1)
    with pytest.raises(ShapeError) as caught:
        rollout(PENDULUM, lambda t, x: output, task)
    assert "(4, m)" in str(caught.value)
    assert f"got {shape}" in str(caught.value)


@pytest.mark.parametrize("later", [[0.0, 0.0], 0.0, []])
def test_an_input_that_changes_its_shape_is_refused_with_both_shapes(later: object) -> None:
    with pytest.raises(ShapeError) as caught:
        rollout(PENDULUM, lambda t, x: np.asarray(later if t else [0.0]), Task([1.0, 0.0], horizon=3, dt=0.1))
    assert_names(str(caught.value), "shape", (1,), np.shape(later))


@pytest.mark.parametrize("shape", [(), (3,), (1, 2)])
def test_a_state_of_the_wrong_shape_is_refused_with_both_shapes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError) as caught:
        rollout(lambda x, u: np.zeros(shape), zero, Task([1.0, 0.0], horizon=3, dt=0.1))
    assert_names(str(caught.value), "shape", (2,))
    assert f"got {shape}" in str(caught.value)


def test_a_step_that_works_in_place_does_not_change_the_recorded_inputs() -> None:
    def weak(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        u *= 0.5
        return x + u

    loop = rollout(weak, lambda t, x: np.ones(1), Task([0.0], horizon=3, dt=0.1))
    np.testing.assert_array_equal(loop.inputs, np.ones((3, 1)))
    np.testing.assert_array_equal(loop.states[:, 0], [0.0, 0.5, 1.0, 1.5])


class Returning:
    """A model of a user's class, which returns its states in another form."""

    def __init__(self, form: Callable[[np.ndarray], Any]) -> None:
        self.form = form

    def step(self, x: np.ndarray, u: np.ndarray) -> Any:
        return self.form(0.9 * x + u)


FORMS: dict[str, Callable[[np.ndarray], Any]] = {
    "complex": lambda x: x + 0j,
    "complex list": lambda x: [complex(value) for value in x],
    "masked": lambda x: np.ma.masked_array(x, [False, True]),
    "texts": lambda x: [str(value) for value in x],
    "text array": lambda x: x.astype(str),
    "booleans": lambda x: x > 0,
    "a boolean in a list": lambda x: [x[0], True],
    "objects": lambda x: np.array([x[0], str(x[1])], dtype=object),
}


@pytest.mark.parametrize("name", FORMS)
def test_states_and_inputs_that_are_no_real_numbers_are_refused(name: str) -> None:
    form, task = FORMS[name], Task([1.0, 2.0], horizon=3, dt=0.1)

    def late(t: int, x: np.ndarray) -> Any:
        return form(x) if t == 2 else x

    for step, controller in (
        (Returning(form).step, lambda t, x: x),
        (Returning(lambda x: x).step, lambda t, x: form(x)),
        (Returning(lambda x: x).step, late),
    ):
        with refuses(InputError, "numbers"):
            rollout(step, controller, task)
        system = Simulated(step)
        with refuses(InputError, "numbers"):
            system.execute(controller, task)


def test_parts_that_work_in_place_change_nothing_that_is_recorded() -> None:
    def in_place(t: int, x: np.ndarray) -> np.ndarray:
        x -= 1
        return x

    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        u *= 0.5
        x += u
        return x

    task = Task([1.0, 2.0], horizon=4, dt=0.1)
    expected = rollout(lambda x, u: x + 0.5 * u, lambda t, x: x - 1, task)
    loop = rollout(step, in_place, task)
    np.testing.assert_array_equal(loop.states, expected.states)
    np.testing.assert_array_equal(loop.inputs, expected.inputs)
    assert task.initial_state.tolist() == [1.0, 2.0]
