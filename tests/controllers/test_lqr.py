from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from ctxval import Task, testing
from ctxval._util.arrays import Array
from ctxval.controllers import ILQR, LQR, StationaryLQR
from ctxval.controllers.lqr import LinearGains, QuadraticCost, linear_gains
from ctxval.core.model import Function, linearize
from ctxval.core.rollout import rollout
from ctxval.errors import DesignError, InputError, ShapeError
from ctxval.models import Linear
from facts import refuses

SIZES = [(1, 1, 3), (2, 1, 10), (3, 2, 7), (4, 4, 5), (2, 3, 12)]


def gram(rng: np.random.Generator, size: int, ridge: float) -> np.ndarray:
    factor = rng.normal(size=(size, size))
    return factor @ factor.T + ridge * np.eye(size)


def problem(n: int, m: int, horizon: int, seed: int, batch: tuple[int, ...] = ()) -> tuple[LQR, Linear, Task]:
    """Return a random tracking problem with an offset, neither strongly stable nor strongly unstable."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 1.05 / np.abs(np.linalg.eigvals(A)).max()
    model = Linear(A, rng.normal(size=(n, m)), rng.normal(size=n))
    reference = rng.normal(size=(*batch, horizon + 1, n))
    task = Task(rng.normal(size=(*batch, n)), horizon=horizon, dt=0.1, reference=reference)
    return LQR(gram(rng, n, 0.0), gram(rng, m, 0.1), gram(rng, n, 0.0)), model, task


def dense_optimum(regulator: LQR, model: Linear, x0: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the inputs ``(H, m)`` that solve the equality-constrained quadratic program by its KKT system.

    The variables are u_0, x_1, u_1, ..., x_H, as they come; one multiplier belongs to each step of the model.
    """
    (n, m), horizon, cost = model.B.shape, len(reference) - 1, regulator.cost
    size, k = horizon * (n + m), n + m
    P, q = np.zeros((size, size)), np.zeros(size)
    G, h = np.zeros((horizon * n, size)), np.tile(model.c, horizon)
    h[:n] += model.A @ x0
    for t in range(horizon):
        u, x, row = slice(t * k, t * k + m), slice(t * k + m, (t + 1) * k), slice(t * n, (t + 1) * n)
        Q = cost.Q_final if t == horizon - 1 else cost.Q
        P[u, u], P[x, x], q[x] = cost.R, Q, -Q @ reference[t + 1]
        G[row, x], G[row, u] = np.eye(n), -model.B
        if t:
            G[row, slice((t - 1) * k + m, t * k)] = -model.A
    kkt = np.block([[P, G.T], [G, np.zeros((len(h), len(h)))]])
    return np.linalg.solve(kkt, np.concatenate([-q, h]))[:size].reshape(horizon, k)[:, :m]


def assert_close(actual: np.ndarray, desired: np.ndarray, relative: float) -> None:
    assert np.abs(actual - desired).max() <= relative * np.abs(desired).max()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("n", "m", "horizon"), SIZES)
def test_the_inputs_are_the_dense_optimum(n: int, m: int, horizon: int, seed: int) -> None:
    regulator, model, task = problem(n, m, horizon, seed)
    inputs = rollout(model.step, regulator.design(task, model), task).inputs
    assert_close(inputs, dense_optimum(regulator, model, task.initial_state, task.reference), 1e-9)


@pytest.mark.parametrize("start", [1, 4, 9])
def test_from_any_state_at_any_time_the_rest_is_optimal(start: int) -> None:
    regulator, model, task = problem(2, 1, 10, 7)
    controller = regulator.design(task, model)
    x = here = np.array([3.0, -2.0])
    inputs = []
    for t in range(start, 10):
        inputs.append(controller(t, x))
        x = model.step(x, inputs[-1])
    assert_close(np.array(inputs), dense_optimum(regulator, model, here, task.reference[start:]), 1e-9)


def test_the_weight_of_the_last_state_is_that_of_the_others_unless_given() -> None:
    _, model, task = problem(2, 1, 6, 0)
    Q, R = [[2.0, 0.3], [0.3, 1.0]], [0.5]
    default, explicit = LQR(Q, R).design(task, model), LQR(Q, R, Q).design(task, model)
    np.testing.assert_array_equal(default.gains, explicit.gains)
    assert not np.allclose(default.gains, LQR(Q, R, [9.0, 9.0]).design(task, model).gains)


def test_far_from_the_end_the_gain_solves_the_algebraic_riccati_equation() -> None:
    from scipy.linalg import solve_discrete_are

    _, model, _ = problem(3, 2, 1, 3)
    task = Task(np.zeros(3), horizon=300, dt=0.1)
    P = solve_discrete_are(model.A, model.B, np.eye(3), np.eye(2))
    stationary = -np.linalg.solve(np.eye(2) + model.B.T @ P @ model.B, model.B.T @ P @ model.A)
    np.testing.assert_allclose(LQR(np.ones(3), np.ones(2)).design(task, model).gains[0], stationary, atol=1e-10)


@pytest.mark.parametrize("batch", [(5,), (2, 3)])
def test_a_batch_of_tasks_is_the_loop_over_them(batch: tuple[int, ...]) -> None:
    regulator, model, task = problem(3, 2, 8, 1, batch)
    whole = rollout(model.step, regulator.design(task, model), task)
    for i in np.ndindex(batch):
        one = Task(task.initial_state[i], horizon=8, dt=0.1, reference=task.reference[i])
        alone = rollout(model.step, regulator.design(one, model), one)
        np.testing.assert_allclose(whole.states[i], alone.states, rtol=0, atol=1e-10)
        np.testing.assert_allclose(whole.inputs[i], alone.inputs, rtol=0, atol=1e-10)


def bend(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return x + 0.1 * np.stack([x[..., 1], np.sin(x[..., 0]) + (1 + x[..., 1] ** 2) * u[..., 0]], axis=-1)


def test_a_nonlinear_model_is_linearised_at_the_initial_state_and_zero_input() -> None:
    model, task = Function(bend), Task([1.0, -0.5], goal=[0.2, 0.0], horizon=9, dt=0.1)
    A, B = linearize(model, task.initial_state, np.zeros(1))
    tangent = Linear(A, B, model.step(task.initial_state, np.zeros(1)) - A @ task.initial_state)
    regulator = LQR([1.0, 0.1], [0.01])
    on_model, on_tangent = regulator.design(task, model), regulator.design(task, tangent)
    np.testing.assert_allclose(on_model.gains, on_tangent.gains, rtol=1e-12)
    np.testing.assert_allclose(on_model.inputs, on_tangent.inputs, rtol=0, atol=1e-10)


@pytest.mark.parametrize("vectorized", [False, True])
def test_each_task_of_a_batch_has_the_gains_of_its_own_initial_state(vectorized: bool) -> None:
    model, regulator = Function(bend, vectorized=vectorized), LQR([1.0, 0.1], [0.01])
    task = Task([np.linspace(-2, 2, 4), 0.5], goal=[np.linspace(0, 1, 4), 0.0], horizon=9, dt=0.1)
    whole = regulator.design(task, model)
    assert whole.gains.shape == (4, 9, 1, 2)
    for i in range(4):
        alone = regulator.design(task[i], model)
        np.testing.assert_allclose(whole[i].gains, alone.gains, rtol=0, atol=1e-10)
        np.testing.assert_allclose(whole[i].inputs, alone.inputs, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("weights", "facts"),
    [
        (([1, -1], [1]), ("Q", [1.0, 0.0], [0.0, -1.0])),
        (([1, 1], [0]), ("R", [0.0])),
        (([1, 1], [-1]), ("R", [-1.0])),
        (([1, 1], [1], [1, -3]), ("Q_final", [1.0, 0.0], [0.0, -3.0])),
        (([1, 1], [1], [1, 1, 1]), ("Q_final", (2, 2), (3, 3))),
        (([1, np.nan], [1]), ("Q",)),
        (([[1, 1], [0, 1]], [1]), ("Q", [1.0, 1.0], [0.0, 1.0])),
    ],
)
def test_bad_weights_are_refused_by_value(weights: tuple[object, ...], facts: tuple[object, ...]) -> None:
    with refuses((InputError, ShapeError), *facts):
        LQR(*weights)


def test_a_task_with_other_states_than_the_weights_is_refused() -> None:
    _, model, task = problem(3, 1, 5, 0)
    with refuses(ShapeError, "Q", 3, (2, 2)):
        LQR([1, 1], [1]).design(task, model)


def test_weights_of_other_inputs_than_the_model_has_are_refused() -> None:
    task = Task([1.0, 0.0], goal=[0.0, 0.0], horizon=3, dt=0.1)
    model = Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]])
    for synthesizer in (LQR([1, 1], [1, 2]), StationaryLQR([1, 1], [1, 2])):
        with refuses(InputError, "R", 1, 2):
            synthesizer.design(task, model)


def test_a_model_without_inputs_needs_another_synthesizer() -> None:
    task = Task([1.0, 0.0], goal=[0.0, 0.0], horizon=3, dt=0.1)
    model = Linear([[1.0, 0.1], [0.0, 1.0]], np.zeros((2, 0)))
    for synthesizer in (LQR([1, 1], [1]), StationaryLQR([1, 1], [1])):
        with refuses(InputError, 0):
            synthesizer.design(task, model)
    with refuses(ShapeError, "R", (0,)):
        LQR([1, 1], [])


# Gains of linear models against scipy, and the conditions under which they are computed again


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
    with refuses(ValueError):
        controller.gains[0] = 0.0


# The stationary regulator against the Riccati recursion, python-control and what equilibria need


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
    with refuses(DesignError, "feedback"):
        StationaryLQR(*WEIGHTS).design(Task([1.0, 0.0], horizon=5, dt=0.1), lame)
    with refuses(ShapeError, 3):
        StationaryLQR(*WEIGHTS).design(Task(np.zeros(3), horizon=5, dt=0.1), CART)
    with refuses(InputError, "R", [[0.0]]):
        StationaryLQR([1.0, 1.0], [0.0])
