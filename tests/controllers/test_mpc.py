"""MPC against LQR where no limit is reached, and against a bounded optimum where one is."""

from __future__ import annotations

import pickle
import sys
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, searches, systems
from ctxval._util.arrays import Array
from ctxval.controllers import LQR, MPC
from ctxval.core.rollout import rollout
from ctxval.errors import DesignError, InputError, ShapeError
from ctxval.models import Function, Linear
from facts import refuses

pytest.importorskip("casadi")

CART = Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], [0.0, 0.01])
TASK = Task([1.0, 0.0], goal=[0.0, 0.0], horizon=30, dt=0.1)
SLOW = [[-np.inf, np.inf], [-0.4, 0.4]]
WEIGHTS: tuple[Any, ...] = ([10.0, 1.0], [0.1], [50.0, 5.0])


def swing(x: Array, u: Array) -> Array:
    rate = x[..., 1] + 0.05 * (9.81 * np.sin(x[..., 0]) + 2 * u[..., 0])
    return np.stack([x[..., 0] + 0.05 * rate, rate], axis=-1)


PENDULUM = Function(swing, vectorized=True)


def predicted(model: Any, x: Array, inputs: Array) -> Array:
    states = [x]
    for u in inputs:
        states.append(model.step(states[-1], u))
    return np.array(states)


def plan_cost(model: Any, x: Array, inputs: Array, goal: Array) -> float:
    Q, R, Q_final = (np.diag(weight) for weight in WEIGHTS)
    gap = predicted(model, x, inputs)[1:] - goal
    last = gap[-1] @ Q_final @ gap[-1]
    return 0.5 * float((gap[:-1] @ Q * gap[:-1]).sum() + last + (inputs @ R * inputs).sum())


def test_without_limits_it_is_lqr_over_the_same_steps() -> None:
    regulator = LQR(*WEIGHTS).design(Task(TASK.initial_state, goal=TASK.goal, horizon=12, dt=0.1), CART)
    controller = MPC(*WEIGHTS, steps=12).design(TASK, CART)
    for x in np.random.default_rng(0).normal(size=(5, 2)):
        np.testing.assert_allclose(controller(0, x), regulator(0, x), rtol=0, atol=1e-9)
    assert controller(0, np.array([1.0, 0.0])).shape == (1,)


def test_a_shrinking_remainder_holds_the_last_reference() -> None:
    moving = Task([0.0, 0.0], reference=np.linspace([0.0, 0.0], [1.0, 0.0], 31), horizon=30, dt=0.1)
    controller = MPC(*WEIGHTS, steps=10).design(moving, CART)
    held = MPC(*WEIGHTS, steps=10).design(Task([0.0, 0.0], goal=[1.0, 0.0], horizon=30, dt=0.1), CART)
    x = np.array([0.8, 0.1])
    np.testing.assert_allclose(controller(29, x), held(29, x), atol=1e-12)
    assert abs(controller(5, x)[0] - held(5, x)[0]) > 0.1


@pytest.mark.parametrize("limit", [0.3, 1.0, 3.0])
def test_with_input_limits_it_is_the_bounded_optimum(limit: float) -> None:
    controller = MPC(*WEIGHTS, steps=12, limits=limit).design(TASK, CART)
    Q, R, Q_final = (np.diag(weight) for weight in WEIGHTS)
    roots = [np.sqrt(Q)] * 11 + [np.sqrt(Q_final)]
    for x in ([1.0, 0.0], [-0.4, 0.8], [0.05, 0.0]):
        start = np.array(x)
        free = predicted(CART, start, np.zeros((12, 1)))[1:]
        responses = [predicted(CART, start, np.eye(12)[:, [k]])[1:] - free for k in range(12)]
        G = np.concatenate(
            [root @ np.stack(responses, -1)[k] for k, root in enumerate(roots)] + [np.sqrt(R[0, 0]) * np.eye(12)]
        )
        g = np.concatenate([*(root @ free[k] for k, root in enumerate(roots)), np.zeros(12)])
        best = lsq_linear(G, -g, (-limit, limit), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(controller.plan(0, start)[1][:, 0], best, rtol=0, atol=1e-7)


def test_state_limits_are_kept_and_cost_something() -> None:
    free = rollout(CART.step, MPC(*WEIGHTS, steps=20).design(TASK, CART), TASK)
    kept = rollout(CART.step, MPC(*WEIGHTS, steps=20, state_limits=SLOW).design(TASK, CART), TASK)
    assert free.states[:, 1].min() < -0.8
    assert kept.states[:, 1].min() >= -0.4 - 1e-9
    assert kept.states[:, 1].min() < -0.39  # the limit is used
    assert abs(kept.final_state[0]) < 0.05


def test_limits_that_cannot_be_kept_are_an_error_unless_soft() -> None:
    hard = MPC(*WEIGHTS, steps=8, limits=1.0, state_limits=SLOW).design(TASK, CART)
    fast = np.array([1.0, -2.0])
    with refuses(DesignError, 3, [1.0, -2.0]):
        hard(3, fast)
    soft = MPC(*WEIGHTS, steps=8, limits=1.0, state_limits=SLOW, violation_cost=1e4).design(TASK, CART)
    np.testing.assert_allclose(soft(3, fast), [1.0], atol=1e-9)  # brakes as hard as it can
    slow = np.array([0.3, -0.1])
    np.testing.assert_allclose(soft(3, slow), hard(3, slow), atol=1e-6)


def test_a_nonlinear_plan_is_a_bounded_optimum_of_the_model() -> None:
    task = Task([0.6, 0.0], goal=[0.0, 0.0], horizon=20, dt=0.05)
    controller = MPC(*WEIGHTS, steps=10, limits=4.0).design(task, PENDULUM)
    states, inputs = controller.plan(0, task.initial_state)
    np.testing.assert_allclose(states, predicted(PENDULUM, task.initial_state, inputs), atol=1e-12)
    assert np.abs(inputs).max() == 4.0
    found = minimize(
        lambda z: plan_cost(PENDULUM, task.initial_state, z[:, None], task.goal),
        np.zeros(10),
        bounds=[(-4.0, 4.0)] * 10,
        options={"ftol": 1e-15, "gtol": 1e-9},
    )
    assert plan_cost(PENDULUM, task.initial_state, inputs, task.goal) <= found.fun * (1 + 1e-6)


def test_a_nonlinear_plan_keeps_state_limits() -> None:
    task = Task([0.6, 0.0], goal=[0.0, 0.0], horizon=20, dt=0.05)
    controller = MPC(*WEIGHTS, steps=15, limits=8.0, state_limits=[[-np.inf, np.inf], [-0.9, 0.9]]).design(
        task, PENDULUM
    )
    states = controller.plan(0, task.initial_state)[0]
    assert np.abs(states[:, 1]).max() <= 0.9 + 1e-6
    assert np.abs(rollout(PENDULUM.step, controller, task).states[:, 1]).max() <= 0.9 + 1e-6


def test_the_input_depends_on_step_and_state_alone() -> None:
    task = Task([0.6, 0.0], goal=[0.0, 0.0], horizon=10, dt=0.05)
    controller = MPC(*WEIGHTS, steps=8, limits=4.0).design(task, PENDULUM)
    first = controller(2, np.array([0.3, 0.1]))
    controller(7, np.array([-0.5, 1.0]))
    np.testing.assert_array_equal(controller(2, np.array([0.3, 0.1])), first)
    linear = MPC(*WEIGHTS, steps=8).design(TASK, CART)
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(linear))(1, TASK.initial_state), linear(1, TASK.initial_state)
    )


def test_a_model_is_validated_under_mpc() -> None:
    validation = Validation(
        space=TaskSpace(start=(0.2, 1.0, "m")),
        task=lambda p: Task([p.start, 0.0], horizon=10, dt=0.1),
        system=systems.Simulated(lambda x, u: CART.step(x, 0.9 * u), vectorized=True),
        model=CART,
        synthesizer=MPC(*WEIGHTS, steps=6, limits=2.0),
        distance=distances.FinalState(),
    )
    campaign = Campaign(validation, search=searches.Random()).run(3)
    assert not campaign.failed


def test_what_cannot_be_used_is_refused() -> None:
    for change in ({"steps": 0}, {"steps": 2.5}, {"steps": 3, "iterations": True}):
        with refuses(InputError, list(change)[-1]):
            MPC(*WEIGHTS, **change)  # type: ignore[arg-type]
    with refuses(InputError, "violation_cost", -1):
        MPC(*WEIGHTS, steps=3, violation_cost=-1)
    with refuses(ShapeError, "limits", (2,)):
        MPC(*WEIGHTS, steps=3, state_limits=[[-1, 1]] * 3)
    with refuses(ShapeError, (2,)):
        MPC(*WEIGHTS, steps=3).design(Task(np.zeros((2, 2)), horizon=3, dt=0.1), CART)
    exploding = Function(lambda x, u: 1e200 * (x + 1) ** 2 + u, vectorized=True)
    with refuses(DesignError, "MPC", 0):
        MPC(*WEIGHTS, steps=4).design(TASK, exploding)(0, TASK.initial_state)


def test_without_casadi_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    with refuses(InputError, "ctxval[mpc]"):
        controllers.MPC(*WEIGHTS, steps=3)
