from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task
from ctxval.core.rollout import rollout
from ctxval.models import Linear
from ctxval.systems import Simulated, System, rk4


def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.stack([x[..., 1], 14.7 * np.sin(x[..., 0]) + 3 * u[..., 0]], axis=-1)


STEP = rk4(derivative, 0.05)


def damp(t: int, x: np.ndarray) -> np.ndarray:
    return -2 * x[..., :1] - x[..., 1:]


@pytest.mark.parametrize("system", [Simulated(STEP, vectorized=True), Simulated(STEP)])
@pytest.mark.parametrize("start", [1.0, np.linspace(-1, 1, 5)])
def test_an_execution_is_the_closed_loop_with_the_step(system: Simulated, start: object) -> None:
    task = Task([start, 0.0], horizon=20, dt=0.05)
    executed, expected = system.execute(damp, task), rollout(STEP, damp, task)
    np.testing.assert_allclose(executed.states, expected.states, rtol=0, atol=1e-12)
    np.testing.assert_allclose(executed.inputs, expected.inputs, rtol=0, atol=1e-12)
    np.testing.assert_allclose(executed.states[..., 0, :], task.initial_state)


def test_a_plain_function_sees_one_state_at_a_time() -> None:
    shapes = set()

    def one(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        shapes.add((x.shape, u.shape))
        return STEP(x, u)

    Simulated(one).execute(damp, Task([np.zeros(3), 1.0], horizon=2, dt=0.05))
    assert shapes == {((2,), (1,))}


def test_a_model_is_a_system() -> None:
    model = Linear([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]])
    system, task = Simulated(model), Task([1.0, -1.0], horizon=5, dt=0.1)
    assert system.model is model
    assert isinstance(system, System)
    np.testing.assert_array_equal(system.execute(damp, task).states, rollout(model.step, damp, task).states)


def test_executions_do_not_remember_each_other() -> None:
    system, task = Simulated(STEP, vectorized=True), Task([1.0, 0.0], horizon=20, dt=0.05)
    first = system.execute(damp, task)
    system.execute(damp, Task([-2.0, 1.0], horizon=5, dt=0.05))
    np.testing.assert_array_equal(system.execute(damp, task).states, first.states)
