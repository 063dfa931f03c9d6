"""State feedback on the estimates of a Kalman filter."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, controllers, models
from ctxval.core.rollout import rollout
from ctxval.core.system import Outputs
from ctxval.errors import InputError, ShapeError
from ctxval.testing import check_synthesizer
from facts import refuses

DT = 0.1
A, B = np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.0], [DT]])
CART = models.Linear(A, B)
LQR = controllers.LQR([10.0, 1.0], [0.1])


def feedback(outputs: object = (0,), process: object = (1e-3, 1e-2), measurement: object = 1e-3) -> object:
    return controllers.OutputFeedback(LQR, outputs, process=process, measurement=measurement)  # type: ignore[arg-type]


def cart(goal: object, n: int = 1) -> Task:
    return Task([0.0, 0.0], goal=[goal, 0.0][:n], horizon=40, dt=DT)


def test_if_m_is_right_the_states_are_known_and_the_inputs_are_those_of_the_state_feedback() -> None:
    controller = feedback().design(cart(1.0), CART)
    seen = rollout(CART.step, Outputs([0]).seen_by(controller), cart(1.0))
    known = rollout(CART.step, LQR.design(cart(1.0, 2), CART), cart(1.0, 2))
    assert seen.inputs == pytest.approx(known.inputs, abs=1e-9)
    assert controller.limits is None
    assert controller.converged is None


def test_a_push_that_m_misses_is_noticed_in_the_outputs() -> None:
    def pushed(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return CART.step(x, u) + np.array([0.0, 0.02])

    def deaf(t: int, y: np.ndarray) -> np.ndarray:
        return unheard.inputs[t]

    controller = feedback().design(cart(1.0), CART)
    unheard = rollout(CART.step, Outputs([0]).seen_by(controller), cart(1.0))
    seen = rollout(pushed, Outputs([0]).seen_by(controller), cart(1.0))
    missed = rollout(pushed, deaf, cart(1.0))
    assert abs(seen.final_state[0] - 1) < 0.2 * abs(missed.final_state[0] - 1)


def test_outputs_that_are_rotated_states_need_no_other_feedback() -> None:
    T = np.array([[1.0, 0.3], [-0.5, 0.8]])
    inverse = np.linalg.inv(T)
    rotated = models.Linear(T @ A @ inverse, T @ B)
    weights = inverse.T @ np.diag([10.0, 1.0]) @ inverse
    synthesizer = controllers.OutputFeedback(
        controllers.LQR(weights, [0.1]), lambda x: x @ inverse.T, process=1e-3, measurement=1e-4
    )
    task = Task([0.0, 0.0], goal=[1.0, 0.0], horizon=40, dt=DT)
    controller = synthesizer.outputs.seen_by(synthesizer.design(task, rotated))
    of_rotated = rollout(rotated.step, controller, task)
    of_states = rollout(CART.step, LQR.design(task, CART), task)
    assert of_rotated.inputs == pytest.approx(of_states.inputs, abs=1e-9)


def test_a_batch_is_designed_as_one_by_one() -> None:
    task = Task([0.0, 0.0], goal=[np.array([0.5, 1.0, 2.0]), 0.0], horizon=20, dt=DT)
    check_synthesizer(feedback([0, 1], 1e-3, (1e-3, 1e-2)), task, CART)


def test_bad_arguments_are_refused() -> None:
    with refuses(InputError, "process", 0.0):
        feedback(process=0.0)
    with refuses(ShapeError, "measurement", (1,), (2,)):
        feedback(measurement=[1.0, 1.0]).design(cart(1.0), CART)
    with refuses(ShapeError, "task", 1, 2):
        feedback().design(cart(1.0, 2), CART)
