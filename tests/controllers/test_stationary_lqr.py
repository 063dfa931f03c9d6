"""The stationary regulator against the Riccati recursion, python-control and what equilibria need."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, testing
from ctxval._util.arrays import Array
from ctxval.controllers import LQR, StationaryLQR
from ctxval.core.rollout import rollout
from ctxval.errors import DesignError, InputError, ShapeError
from ctxval.models import Function, Linear

CART = Linear([[1.0, 0.1], [0.0, 0.95]], [[0.0], [0.1]])
WEIGHTS = ([10.0, 1.0], [0.1])


def swing(x: Array, u: Array) -> Array:
    rate = x[..., 1] + 0.05 * (9.81 * np.sin(x[..., 0]) + 2 * u[..., 0])
    return np.stack([x[..., 0] + 0.05 * rate, rate], axis=-1)


PENDULUM = Function(swing, vectorized=True)


def test_it_is_the_recursion_far_from_the_end() -> None:
    task = Task([1.0, 0.0], horizon=400, dt=0.1)
    K = StationaryLQR(*WEIGHTS).design(task, CART).gains
    assert K.shape == (400, 1, 2)
    np.testing.assert_array_equal(K[0], K[-1])
    np.testing.assert_allclose(K[0], LQR(*WEIGHTS).design(task, CART).gains[0], rtol=0, atol=1e-10)


def test_it_is_that_of_python_control() -> None:
    control = pytest.importorskip("control")
    K = control.dlqr(CART.A, CART.B, np.diag(WEIGHTS[0]), np.diag(WEIGHTS[1]))[0]
    np.testing.assert_allclose(StationaryLQR(*WEIGHTS).design(Task([1.0, 0.0], horizon=3, dt=0.1), CART).gains[0], -K)


@pytest.mark.parametrize("goal", [0.0, 0.5, 2.5])
def test_a_goal_is_reached_and_held_with_the_input_that_it_needs(goal: float) -> None:
    task = Task([goal + 0.2, 0.0], goal=[goal, 0.0], horizon=200, dt=0.05)
    controller = StationaryLQR(*WEIGHTS).design(task, PENDULUM)
    np.testing.assert_allclose(controller.inputs[0], [-9.81 * np.sin(goal) / 2], atol=1e-9)
    np.testing.assert_allclose(rollout(PENDULUM.step, controller, task).final_state, [goal, 0.0], atol=1e-8)


def test_it_follows_a_reference() -> None:
    reference = np.stack([np.linspace(0, 1, 101), np.full(101, 0.1)], axis=-1)
    task = Task([0.0, 0.1], reference=reference, horizon=100, dt=0.1)
    states = rollout(CART.step, StationaryLQR(*WEIGHTS).design(task, CART), task).states
    assert np.abs(states[:, 0] - reference[:, 0]).max() < 0.03


def test_a_batch_is_the_loop_over_it_with_its_own_gains() -> None:
    tasks = Task([np.linspace(-1, 1, 4), 0.0], goal=[np.linspace(0, 2, 4), 0.0], horizon=20, dt=0.05)
    testing.check_synthesizer(StationaryLQR(*WEIGHTS, limits=8.0), tasks, PENDULUM)
    testing.check_synthesizer(StationaryLQR(*WEIGHTS), tasks, CART)
    gains = StationaryLQR(*WEIGHTS).design(tasks, PENDULUM).gains
    assert gains.shape == (4, 20, 1, 2)
    assert not np.allclose(gains[0], gains[3])


def test_limits_clip() -> None:
    task = Task([1.0, 0.0], horizon=60, dt=0.1)
    inputs = rollout(CART.step, StationaryLQR(*WEIGHTS, limits=0.5).design(task, CART), task).inputs
    assert np.abs(inputs).max() == 0.5


def test_what_cannot_be_stabilised_is_said() -> None:
    lame = Linear([[1.1, 0.0], [0.0, 0.5]], [[0.0], [1.0]])
    with pytest.raises(DesignError, match="no stationary feedback stabilises the model at the goal"):
        StationaryLQR(*WEIGHTS).design(Task([1.0, 0.0], horizon=5, dt=0.1), lame)
    with pytest.raises(ShapeError, match="must weigh the task's 3 states"):
        StationaryLQR(*WEIGHTS).design(Task(np.zeros(3), horizon=5, dt=0.1), CART)
    with pytest.raises(InputError, match="R must be positive definite"):
        StationaryLQR([1.0, 1.0], [0.0])
