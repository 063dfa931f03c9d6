"""Steps of the backward pass against general optimisers of the same quadratic problems."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from ctxval.controllers.ilqr import Expansion, _inverses, _solved, minimise
from ctxval.controllers.lqr import QuadraticCost
from ctxval.core.controller import Limits


def random_expansion(seed: int, horizon: int = 4, tasks: int = 3, n: int = 3, m: int = 2) -> Expansion:
    rng = np.random.default_rng(seed)
    shape = (horizon, tasks)
    return Expansion(
        rng.normal(size=(horizon + 1, tasks, n)),
        rng.uniform(-0.5, 0.5, (*shape, m)),
        rng.normal(size=(*shape, n, n)),
        rng.normal(size=(*shape, n, m)),
    )


def whole_problem(cost: QuadraticCost, around: Expansion, task: int) -> tuple[np.ndarray, np.ndarray]:
    """Return root and target of ``|root k - target|^2``, which is twice the expanded cost of inputs ``U + k``."""
    horizon, m = around.inputs.shape[0], around.inputs.shape[2]
    n = around.deviations.shape[2]
    G = np.zeros((n, horizon * m))
    rows, target = [], []
    for t in range(horizon + 1):
        root = np.linalg.cholesky(cost.Q_final if t == horizon else cost.Q).T
        rows.append(root @ G)
        target.append(-root @ around.deviations[t, task])
        if t < horizon:
            own = np.zeros((m, horizon * m))
            own[:, t * m : (t + 1) * m] = np.eye(m)
            root = np.linalg.cholesky(cost.R).T
            rows.append(root @ own)
            target.append(-root @ around.inputs[t, task])
            G = around.A[t, task] @ G + around.B[t, task] @ own
    return np.vstack(rows), np.concatenate(target)


def applied(around: Expansion, policy: object, task: int) -> np.ndarray:
    """Return the change of the inputs on the linearised model, ``(H * m,)``."""
    dx, changes = np.zeros(around.deviations.shape[2]), []
    for t in range(len(around.inputs)):
        du = policy.k[t, task] + policy.K[t, task] @ dx
        dx = around.A[t, task] @ dx + around.B[t, task] @ du
        changes.append(du)
    return np.concatenate(changes)


COST = QuadraticCost([1.0, 0.5, 2.0], [0.3, 1.0], [5.0, 5.0, 1.0])


@pytest.mark.parametrize("seed", range(3))
def test_without_limits_the_step_minimises_the_expansion(seed: int) -> None:
    around = random_expansion(seed)
    policy = minimise(COST, around, None, np.zeros(3))
    for task in range(3):
        root, target = whole_problem(COST, around, task)
        expected = np.linalg.lstsq(root, target)[0]
        np.testing.assert_allclose(applied(around, policy, task), expected, rtol=0, atol=1e-9)
        fall = 0.5 * (((root @ expected - target) ** 2).sum() - (target**2).sum())
        np.testing.assert_allclose((policy.slope + 0.5 * policy.curvature)[task], fall, rtol=1e-9)


def test_constant_derivatives_give_the_step_of_repeated_ones() -> None:
    around = random_expansion(0)
    constant = Expansion(around.deviations, around.inputs, around.A[0, 0], around.B[0, 0])
    repeated = Expansion(
        around.deviations,
        around.inputs,
        np.broadcast_to(constant.A, around.A.shape),
        np.broadcast_to(constant.B, around.B.shape),
    )
    for limits in (None, Limits.of(0.6, 2)):
        for damping in (np.zeros(3), np.array([0.0, 0.1, 1.0])):
            ours, theirs = (minimise(COST, one, limits, damping) for one in (constant, repeated))
            np.testing.assert_allclose(ours.k, theirs.k, rtol=0, atol=1e-10)
            np.testing.assert_allclose(
                np.broadcast_to(ours.K if ours.K.ndim == 4 else ours.K[:, None], theirs.K.shape),
                theirs.K,
                rtol=0,
                atol=1e-10,
            )
            np.testing.assert_allclose(ours.slope, theirs.slope, rtol=1e-9)
            np.testing.assert_allclose(ours.curvature, theirs.curvature, rtol=1e-9)


def test_damping_shortens_the_step_of_its_task_only() -> None:
    around = random_expansion(1)
    free, damped = (minimise(COST, around, None, np.array([0.0, extra, 0.0])) for extra in (0.0, 100.0))
    np.testing.assert_allclose(damped.k[:, [0, 2]], free.k[:, [0, 2]], rtol=0, atol=1e-9)
    assert np.abs(damped.k[:, 1]).max() < 0.2 * np.abs(free.k[:, 1]).max()


@pytest.mark.slow
@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 5))
def test_a_stage_with_limits_is_the_bounded_minimum(seed: int, m: int, tasks: int) -> None:
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(tasks, m, m)) + 0.3 * np.eye(m)
    Q_uu, Q_u = np.swapaxes(roots, -1, -2) @ roots + 0.05 * np.eye(m), 3 * rng.normal(size=(tasks, m))
    Q_ux = rng.normal(size=(tasks, m, 2))
    low, high = -rng.uniform(0, 1, (1, tasks, m)), rng.uniform(0, 1, (1, tasks, m))
    K, k = _solved(Q_uu, Q_u, Q_ux, (low[0], high[0]))
    for i in range(tasks):
        root = np.linalg.cholesky(Q_uu[i]).T
        expected = lsq_linear(root, -np.linalg.solve(root.T, Q_u[i]), (low[0, i], high[0, i]), method="bvls", tol=1e-14)
        np.testing.assert_allclose(k[i], expected.x, rtol=0, atol=1e-7)
        free = (k[i] > low[0, i]) & (k[i] < high[0, i])
        assert (K[i][~free] == 0).all()
        gains = -np.linalg.solve(Q_uu[i][np.ix_(free, free)], Q_ux[i][free])
        np.testing.assert_allclose(K[i][free], gains, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("tasks", [1, 300])
def test_inverses_are_those_of_lapack(m: int, tasks: int) -> None:
    rng = np.random.default_rng(m)
    roots = rng.normal(size=(tasks, m, m))
    matrices = np.swapaxes(roots, -1, -2) @ roots + 0.1 * np.eye(m)
    np.testing.assert_allclose(_inverses(matrices), np.linalg.inv(matrices), rtol=1e-9)
