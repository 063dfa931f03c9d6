from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Task, Trajectory, systems, testing
from ctxval._util.arrays import Array
from ctxval.core.controller import Feedback
from ctxval.errors import ExecutionError, InputError
from facts import refuses

TASK = Task([1.0, -0.5], horizon=8, dt=0.1)


def feedback(t: int, x: Array) -> Array:
    return -0.5 * x[..., :1] + 0.1 * t


def slide(x: Array, u: Array) -> Array:
    return x + 0.1 * np.concatenate([x[..., 1:], u], axis=-1)


def run(controller: Feedback, task: Task) -> tuple[list[Array], list[Array]]:
    """Run the loop that a user would write."""
    x, states, inputs = task.initial_state, [task.initial_state], []
    for t in range(task.horizon):
        inputs.append(controller(t, x))
        x = slide(x, inputs[-1])
        states.append(x)
    return states, inputs


def run_batch(controller: Feedback, task: Task) -> Trajectory:
    states, inputs = run(controller, task)
    return Trajectory(task.times, np.stack(states, axis=-2), np.stack(inputs, axis=-2))


def test_states_and_inputs_become_a_trajectory() -> None:
    trajectory = systems.Function(run).execute(feedback, TASK)
    expected = systems.Simulated(slide, vectorized=True).execute(feedback, TASK)
    np.testing.assert_array_equal(trajectory.states, expected.states)
    np.testing.assert_array_equal(trajectory.inputs, expected.inputs)
    np.testing.assert_array_equal(trajectory.times, TASK.times)


@pytest.mark.parametrize("system", [systems.Function(run), systems.Function(run_batch, vectorized=True)])
def test_it_keeps_the_contract_of_a_system(system: systems.Function) -> None:
    testing.check_system(system, feedback, TASK)


def test_a_trajectory_is_passed_on_as_it_is() -> None:
    stopped = Trajectory(TASK.times[:3], np.zeros((3, 2)), np.zeros((2, 1)), ended="operator stop")
    assert systems.Function(lambda controller, task: stopped).execute(feedback, TASK) is stopped


@pytest.mark.parametrize(
    "returned",
    [
        *(None, 3, np.zeros((9, 2)), (np.zeros((9, 2)),), (np.zeros((5, 2)), np.zeros((4, 1))), ("a", "b")),
        (np.ma.masked_equal(np.zeros((9, 2)), 0), np.zeros((8, 1))),
    ],
)
def test_anything_else_is_a_failed_execution(returned: Any) -> None:
    with refuses(ExecutionError, "H", 8):
        systems.Function(lambda controller, task: returned).execute(feedback, TASK)


def test_what_is_no_function_is_refused() -> None:
    with refuses(InputError, "execute", 3):
        systems.Function(3)  # type: ignore[arg-type]
