"""State-space models against python-control's own simulation and discretisation."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.signal

from ctxval import Task, controllers, testing
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ShapeError
from ctxval.models import state_space
from facts import refuses

control = pytest.importorskip("control")

A, B = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.array([[0.0], [1.5]])


def continuous() -> Any:
    return control.ss(A, B, np.eye(2), np.zeros((2, 1)))


def test_a_continuous_system_is_discretised_as_python_control_does_it() -> None:
    model, sampled = state_space(continuous(), 0.1), control.c2d(continuous(), 0.1, "zoh")
    np.testing.assert_allclose(model.A, sampled.A, rtol=0, atol=1e-13)
    np.testing.assert_allclose(model.B, sampled.B, rtol=0, atol=1e-13)
    testing.check_model(model, states=2, inputs=1)


def test_held_inputs_give_the_exact_response() -> None:
    model, task = state_space(continuous(), 0.1), Task([1.0, 0.0], horizon=30, dt=0.1)
    trajectory = rollout(model.step, lambda t, x: np.array([1.0]), task)
    exact = control.forced_response(continuous(), task.times, np.ones((1, 31)), [1.0, 0.0], return_x=True).states
    np.testing.assert_allclose(trajectory.states, exact.T, rtol=0, atol=1e-10)


@pytest.mark.parametrize("dt", [0.1, True])
def test_a_discrete_system_is_taken_as_it_is(dt: Any) -> None:
    model = state_space(control.ss(A, B, np.eye(2), np.zeros((2, 1)), dt), 0.1)
    np.testing.assert_array_equal(model.A, A)
    np.testing.assert_array_equal(model.jacobian(np.zeros(2), np.zeros(1))[1], B)


def test_systems_of_scipy_will_do() -> None:
    parts = (A, B, np.eye(2), np.zeros((2, 1)))
    np.testing.assert_allclose(state_space(scipy.signal.StateSpace(*parts), 0.1).A, state_space(continuous(), 0.1).A)
    np.testing.assert_array_equal(state_space(scipy.signal.StateSpace(*parts, dt=0.1), 0.1).A, A)


def test_controllers_are_designed_on_it() -> None:
    task = Task([1.0, 0.0], goal=[0.3, 0.0], horizon=60, dt=0.1)
    model = state_space(continuous(), 0.1)
    final = rollout(model.step, controllers.LQR([10.0, 1.0], [0.01]).design(task, model), task).final_state
    assert abs(final[0] - 0.3) < 0.05


def test_what_cannot_be_used_is_refused() -> None:
    with refuses(InputError, "dt", 0.2, 0.1):
        state_space(control.ss(A, B, np.eye(2), np.zeros((2, 1)), 0.2), 0.1)
    none = np.zeros((2, 1))
    for C, D in ((np.array([[1.0, 0.0]]), none[:1]), (np.eye(2), none + 1), (2 * np.eye(2), none)):
        for made in (control.ss(A, B, C, D), control.ss(A, B, C, D, 0.1), scipy.signal.StateSpace(A, B, C, D)):
            with refuses(InputError, "C", "D", 0):
                state_space(made, 0.1)
    with refuses(InputError, "B", 3):
        state_space(3, 0.1)
    with refuses(InputError, 0, "dt"):
        state_space(continuous(), 0)
    with refuses(ShapeError, "A", "B", (2, 2)):
        state_space(SimpleNamespace(A=A, B=B.T), 0.1)
