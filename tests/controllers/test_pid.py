"""PID control: a controller with memory."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Task, controllers, testing
from ctxval._util.arrays import Array
from ctxval._util.describe import describe
from ctxval.controllers import PID
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear
from facts import refuses

DT = 0.1
CART = Linear([[1.0, DT], [0.0, 0.95]], [[0.0], [DT]])
TWO = Linear(np.eye(2), DT * np.eye(2))


def task(goals: Any = 1.0, horizon: int = 40) -> Task:
    start = np.zeros_like(np.asarray(goals, dtype=float))
    return Task([start, 0.0], goal=[goals, 0.0], horizon=horizon, dt=DT)


def inputs_along(pid: PID, states: Array, goal: float = 1.0) -> Array:
    """Return the inputs along measured states ``(H, n)``."""
    whole = Task(states[0], goal=[goal] * states.shape[1], horizon=len(states), dt=DT)
    pi = controllers.started(pid.design(whole, CART), whole)
    return np.stack([pi(t, x) for t, x in enumerate(states)])


def test_the_input_is_the_formula() -> None:
    y = np.random.default_rng(0).normal(size=(9, 1))
    error, rate = 1.0 - y, np.diff(y, axis=0, prepend=y[:1]) / DT
    expected = 0.5 + 2 * error + 3 * DT * np.cumsum(error, axis=0) - 0.7 * rate
    np.testing.assert_allclose(inputs_along(PID(2.0, 3.0, 0.7, bias=0.5), y), expected, rtol=1e-12)


def test_the_derivative_is_that_of_the_state_and_may_be_filtered() -> None:
    jump = Task([0.0], reference=np.repeat([[0.0], [1.0]], [3, 4], axis=0), horizon=6, dt=DT)
    pi = controllers.started(PID(0.0, 0.0, 1.0).design(jump, CART), jump)
    assert [pi(t, np.zeros(1))[0] for t in range(6)] == [0.0] * 6  # the step of the reference causes no peak
    ramp = DT * np.arange(60.0)[:, None]
    filtered = inputs_along(PID(0.0, 0.0, 1.0, derivative_filter=0.3), ramp)[:, 0]
    steps = np.arange(60)
    np.testing.assert_allclose(filtered, -(1 - 0.75**steps), rtol=1e-9)


def test_the_integral_removes_the_offset_of_a_constant_load() -> None:
    def loaded(x: Array, u: Array) -> Array:
        return np.asarray(CART.step(x, u - 0.4))

    ends = [
        rollout(loaded, PID(4.0, ki, 3.0, limits=5.0).design(task(horizon=400), CART), task(horizon=400)).final_state[0]
        for ki in (0.0, 1.0)
    ]
    assert ends[0] == pytest.approx(0.9, abs=1e-3)
    assert ends[1] == pytest.approx(1.0, abs=1e-3)


def test_the_integral_does_not_wind_up_at_a_limit() -> None:
    def overshoot(limits: float | None) -> float:
        controller = PID(2.0, 1.0, limits=limits).design(far, integrator)
        states = rollout(lambda x, u: integrator.step(x, np.clip(u, -0.5, 0.5)), controller, far).states
        return float(states.max() - 5)

    integrator, far = Linear([[1.0]], [[DT]]), Task([0.0], goal=[5.0], horizon=400, dt=DT)
    assert overshoot(None) > 3
    assert overshoot(0.5) < 0.3
    held = inputs_along(PID(0.0, 10.0, limits=0.5), np.array([[0.0]] * 20 + [[2.0]]))
    assert held[:, 0] == pytest.approx([0.5] * 20 + [-0.5])  # the error turns, and so does the input, at once


@given(
    st.lists(st.floats(-5, 5), min_size=1, max_size=9),
    st.floats(0, 20),
    st.floats(0, 20),
    st.floats(0.1, 3.0),
)
def test_inputs_stay_within_the_limits_and_are_continuous_in_the_states(
    path: list[float], ki: float, kd: float, limit: float
) -> None:
    y = np.array(path)[:, None]
    pid = PID(1.0, ki, kd, limits=limit)
    u = inputs_along(pid, y)
    assert (np.abs(u) <= limit).all()
    np.testing.assert_allclose(inputs_along(pid, y + 1e-9), u, atol=1e-5)


@given(
    st.lists(st.floats(-3, 3), min_size=1, max_size=4),
    st.floats(0, 10),
    st.floats(0, 5),
    st.sampled_from([None, 0.5, 4.0]),
)
def test_a_batch_many_draws_and_single_tasks_are_the_same(
    goals: list[float], ki: float, kd: float, limits: float | None
) -> None:
    pid, batch = PID(3.0, ki, kd, limits=limits), task(np.array(goals))
    controller = pid.design(batch, CART)
    together = rollout(CART.step, controller, batch)
    starts = np.stack([batch.initial_state, batch.initial_state + 0.5])
    drawn = Task(starts, horizon=batch.horizon, dt=DT, reference=batch.reference)
    of_draws = rollout(CART.step, controller, drawn)
    again = rollout(CART.step, controller, batch)
    np.testing.assert_array_equal(again.states, together.states)
    for k in range(len(goals)):
        alone = rollout(CART.step, controller[k], batch[k])
        np.testing.assert_allclose(together.states[k], alone.states, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(of_draws.states[0, k], alone.states, rtol=1e-10, atol=1e-10)
        other = rollout(CART.step, pid.design(batch[k], CART), drawn[1][k])
        np.testing.assert_allclose(of_draws.states[1, k], other.states, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("pid", [PID(3.0, 1.0, 2.0), PID(3.0, 5.0, 0.5, limits=[[-0.5, 1.0]], derivative_filter=0.2)])
def test_it_conforms(pid: PID) -> None:
    testing.check_synthesizer(pid, task(np.linspace(-1, 1, 4)), CART)
    sent = pickle.loads(pickle.dumps(pid.design(task(), CART)))
    here, there = (rollout(CART.step, each, task()).states for each in (pid.design(task(), CART), sent))
    np.testing.assert_array_equal(here, there)


def test_each_chosen_state_has_an_input_and_a_matrix_mixes_them() -> None:
    y = np.array([[1.0, 2.0]])
    assert inputs_along(PID([2.0, 3.0], components=(0, 1)), y, 0.0).tolist() == [[-2.0, -6.0]]
    assert inputs_along(PID([2.0, 3.0], components=(1, 0)), y, 0.0).tolist() == [[-4.0, -3.0]]
    assert inputs_along(PID([[2.0, 3.0]], components=(0, 1)), y, 0.0).tolist() == [[-8.0]]
    assert rollout(TWO.step, PID(1.0, components=(0, 1)).design(task(), TWO), task()).inputs.shape == (40, 2)


def test_it_is_described_by_its_gains() -> None:
    described = describe(controllers.by_name("PID", kp=2.0, ki=1.0, limits=3.0))
    assert described["kp"] == [[2.0]]
    assert described["limits"]["high"] == [3.0]
    assert describe(PID(2.0)) != describe(PID(2.0, 0.1))


def test_wrong_arguments_are_refused() -> None:
    with refuses(InputError, "components", 0, [0, 0]):
        PID(1.0, components=(0, 0))
    with refuses(InputError, "components", 2, [2]):
        PID(1.0, components=(2,)).design(task(), CART)
    with refuses(ShapeError, "kp", 1):
        PID([1.0, 2.0])
    with refuses(ShapeError, "ki", (1, 2), 2.0):
        PID([[1.0, 2.0]], 2.0, components=(0, 1))
    with refuses(ShapeError, 2, "kd"):
        PID([[1.0, 2.0]], [[1.0]], components=(0, 1))
    with refuses(ShapeError, "bias", 1):
        PID(1.0, bias=[1.0, 2.0])
    with refuses(InputError, "derivative_filter", 0):
        PID(1.0, derivative_filter=-1.0)
