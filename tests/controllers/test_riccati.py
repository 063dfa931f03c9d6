"""Gains of linear models against scipy, and the conditions under which they are computed again."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from ctxval import Task
from ctxval.controllers import ILQR, LQR
from ctxval.controllers.lqr import LinearGains, QuadraticCost, linear_gains
from ctxval.models import Linear

A, B = np.array([[1.0, 0.1], [0.3, 0.9]]), np.array([[0.0], [0.1]])
COST = QuadraticCost([1.0, 0.1], [0.01])


def test_the_first_gain_of_a_long_horizon_is_the_stationary_gain() -> None:
    P = solve_discrete_are(A, B, COST.Q, COST.R)
    stationary = -np.linalg.solve(COST.R + B.T @ P @ B, B.T @ P @ A)
    found = linear_gains(COST, A, B, 400)
    np.testing.assert_allclose(found.gains[0], stationary, rtol=1e-10)
    np.testing.assert_allclose(found.closed[0], A + B @ stationary, rtol=1e-10)
    np.testing.assert_allclose(found.curvatures[0], P, rtol=1e-10)
    np.testing.assert_allclose(found.inverses[0] @ (COST.R + B.T @ P @ B), np.eye(1), rtol=1e-10)


def test_equal_numbers_are_computed_once() -> None:
    again = linear_gains(QuadraticCost([1.0, 0.1], [0.01]), A.copy(), np.asfortranarray(B), 20)
    assert linear_gains(COST, A, B, 20) is again


@pytest.mark.parametrize(
    ("cost", "A_", "B_", "horizon"),
    [
        (COST, A + 1e-12, B, 20),
        (COST, A, B * (1 + 1e-12), 20),
        (COST, A, B, 21),
        (QuadraticCost([1.0, 0.2], [0.01]), A, B, 20),
        (QuadraticCost([1.0, 0.1], [0.02]), A, B, 20),
        (QuadraticCost([1.0, 0.1], [0.01], [5.0, 5.0]), A, B, 20),
    ],
)
def test_other_numbers_have_gains_of_their_own(
    cost: QuadraticCost, A_: np.ndarray, B_: np.ndarray, horizon: int
) -> None:
    def differs(one: LinearGains, other: LinearGains) -> bool:
        return one.gains.shape != other.gains.shape or not np.array_equal(one.gains, other.gains)

    assert differs(linear_gains(cost, A_, B_, horizon), linear_gains(COST, A, B, 20))


@pytest.mark.parametrize("synthesizer", [LQR([1.0, 0.1], [0.01]), ILQR([1.0, 0.1], [0.01])])
def test_a_model_that_is_changed_in_place_gets_new_gains(synthesizer: LQR | ILQR) -> None:
    task = Task([1.0, 0.0], horizon=20, dt=0.1)
    model = Linear(A.copy(), B.copy())
    before = synthesizer.design(task, model).gains.copy()
    model.A[0, 1] = 0.2
    changed = synthesizer.design(task, model).gains
    np.testing.assert_array_equal(changed, synthesizer.design(task, Linear(model.A.copy(), B)).gains)
    assert np.abs(changed - before).max() > 1e-3


def test_gains_that_controllers_share_cannot_be_changed() -> None:
    task, model = Task([[1.0, 2.0], 0.0], horizon=20, dt=0.1), Linear(A, B)
    controller = LQR([1.0, 0.1], [0.01]).design(task, model)
    assert controller.gains is LQR([1.0, 0.1], [0.01]).design(task, model).gains
    with pytest.raises(ValueError, match="read-only"):
        controller.gains[0] = 0.0
