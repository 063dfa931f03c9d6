"""LQR clips at input limits; iLQR plans with them, as an independent optimiser of the bounded problem does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from ctxval import Task, testing
from ctxval._util.arrays import Array
from ctxval._util.describe import describe
from ctxval.controllers import ILQR, LQR, Limits
from ctxval.core.rollout import rollout
from ctxval.errors import InputError
from ctxval.models import Function, Linear
from facts import refuses
from rig_thorough import more

Q, R, Q_FINAL = [10.0, 1.0], [0.1], [50.0, 5.0]


def predicted(model: Any, x: Array, inputs: Array) -> Array:
    states = [x]
    for u in inputs:
        states.append(model.step(states[-1], u))
    return np.array(states)


def bounded_optimum(model: Linear, task: Task, weights: tuple[Array, Array, Array], low: Array, high: Array) -> Array:
    """Return the inputs ``(H, m)`` that solve the bounded least-squares problem of a linear model."""
    horizon, m = task.horizon, model.B.shape[1]
    free = predicted(model, task.initial_state, np.zeros((horizon, m)))[1:]
    unit = np.eye(horizon * m).reshape(-1, horizon, m)
    G = np.stack([predicted(model, task.initial_state, row)[1:] - free for row in unit], axis=-1)
    roots = [np.linalg.cholesky(weight + 1e-14 * np.eye(len(weight))).T for weight in weights]
    roots_x = [roots[0]] * (horizon - 1) + [roots[2]]
    gaps = free - task.reference[1:]
    A = np.concatenate([*(root @ G[k] for k, root in enumerate(roots_x)), np.kron(np.eye(horizon), roots[1])])
    b = np.concatenate([*(root @ gaps[k] for k, root in enumerate(roots_x)), np.zeros(horizon * m)])
    found = lsq_linear(A, -b, (np.tile(low, horizon), np.tile(high, horizon)), method="bvls", tol=1e-15, max_iter=500)
    return np.asarray(found.x.reshape(horizon, m))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("n", "m"), [(2, 1), (3, 2), (4, 3)])
def test_ilqr_on_a_linear_model_finds_the_bounded_optimum(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    model = Linear(A / np.abs(np.linalg.eigvals(A)).max(), rng.normal(size=(n, m)), 0.1 * rng.normal(size=n))
    task = Task(rng.normal(size=n), goal=rng.normal(size=n), horizon=8, dt=0.1)
    factor = rng.normal(size=(m, m))
    weights = np.eye(n), factor @ factor.T + 0.1 * np.eye(m), 3 * np.eye(n)
    low, high = -rng.uniform(0.05, 0.2, m), rng.uniform(0.05, 0.2, m)
    solution = ILQR(*weights, limits=Limits(low, high), iterations=200, tolerance=1e-13).solve(task, model)
    best = bounded_optimum(model, task, weights, low, high)
    assert ((best == low) | (best == high)).any()
    assert solution.converged
    np.testing.assert_allclose(solution.controller.inputs, best, rtol=0, atol=1e-5)


def swing(x: Array, u: Array) -> Array:
    rate = x[..., 1] + 0.05 * (9.81 * np.sin(x[..., 0]) + 2 * u[..., 0])
    return np.stack([x[..., 0] + 0.05 * rate, rate], axis=-1)


PENDULUM = Function(swing, vectorized=True)


def cost(inputs: Array, task: Task) -> float:
    gaps = predicted(PENDULUM, task.initial_state, inputs) - task.reference
    running = (gaps[:-1] ** 2 @ Q).sum() + (inputs**2 @ R).sum()
    return 0.5 * float(running + gaps[-1] ** 2 @ Q_FINAL)


@pytest.mark.parametrize("start", [0.8, *more(0.4, -0.6)])
def test_ilqr_on_a_nonlinear_model_is_no_worse_than_a_bounded_optimiser(start: float) -> None:
    task = Task([start, 0.0], goal=[0.0, 0.0], horizon=20, dt=0.05)
    solution = ILQR(Q, R, Q_FINAL, limits=4.5).solve(task, PENDULUM)
    assert np.abs(solution.controller.inputs).max() == 4.5
    assert solution.converged
    found = minimize(
        lambda z: cost(z[:, None], task), np.zeros(20), bounds=[(-4.5, 4.5)] * 20, options={"ftol": 1e-14, "gtol": 1e-8}
    )
    assert cost(solution.controller.inputs, task) <= found.fun * (1 + 1e-4)
    assert solution.cost == pytest.approx(cost(solution.controller.inputs, task))


@pytest.mark.parametrize("synthesizer", [LQR(Q, R, Q_FINAL, limits=3.0), ILQR(Q, R, Q_FINAL, limits=[[-3.0, 2.0]])])
def test_inputs_stay_within_the_limits_on_model_and_system(synthesizer: Any) -> None:
    tasks = Task([np.linspace(-0.8, 0.8, 5), 0.3], goal=[0.0, 0.0], horizon=20, dt=0.05)
    testing.check_synthesizer(synthesizer, tasks, PENDULUM)
    controller = synthesizer.design(tasks, PENDULUM)
    for step in (PENDULUM.step, lambda x, u: swing(x, 0.7 * u) + 0.01):
        inputs = rollout(step, controller, tasks).inputs
        assert (inputs >= synthesizer.limits.low).all()
        assert (inputs <= synthesizer.limits.high).all()
        assert np.isin(inputs, [*synthesizer.limits.low, *synthesizer.limits.high]).any()


@pytest.mark.parametrize("kind", [LQR, ILQR])
def test_limits_that_are_never_reached_change_nothing(kind: Any) -> None:
    tasks = Task([np.linspace(-0.5, 0.5, 3), 0.1], goal=[0.0, 0.0], horizon=15, dt=0.05)
    free, limited = (kind(Q, R, **o).design(tasks, PENDULUM) for o in ({}, {"limits": 1e6}))
    np.testing.assert_allclose(limited.inputs, free.inputs, rtol=0, atol=1e-6)
    np.testing.assert_allclose(limited.gains, free.gains, rtol=0, atol=1e-4)


def test_the_controller_of_one_task_keeps_the_limits() -> None:
    tasks = Task([[0.8, -0.8], 0.0], horizon=15, dt=0.05)
    one = ILQR(Q, R, limits=2.0).design(tasks, PENDULUM)[1]
    assert one.limits is not None
    assert np.abs(one(0, np.array([9.0, 9.0]))).max() == 2.0


def test_limits_that_exclude_zero_are_kept_from_the_first_iterate_on() -> None:
    task = Task([0.5, 0.0], horizon=15, dt=0.05)
    inputs = ILQR(Q, R, limits=[[0.5, 2.0]]).solve(task, PENDULUM).controller.inputs
    assert ((inputs >= 0.5) & (inputs <= 2.0)).all()


@pytest.mark.parametrize("kind", [LQR, ILQR])
def test_limits_are_checked_and_described(kind: Any) -> None:
    with refuses(InputError, "high", "limits"):
        kind(Q, R, limits=[(1.0, -1.0)])
    with refuses(InputError, "limits = [[0.5, 2.0]]"):
        kind(Q, R, limits={"low": 0.5, "high": 2.0})
    assert describe(kind(Q, R, limits=2.0))["limits"]["high"] == [2.0]
    assert "limits" not in describe(kind(Q, R))
