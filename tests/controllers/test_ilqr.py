from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from ctxval import Task
from ctxval.controllers import ILQR, LQR
from ctxval.controllers.ilqr import ILQRSolution
from ctxval.core.model import Function, Model, linearize
from ctxval.core.rollout import rollout
from ctxval.errors import DesignError, InputError, ModelError, ShapeError
from ctxval.models import Linear
from ctxval.systems.functions import rk4
from facts import refuses
from rig_thorough import more

DT = 0.05


def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.stack([x[..., 1], 14.7 * np.sin(x[..., 0]) + 3 * u[..., 0]], axis=-1)


PENDULUM = Function(rk4(derivative, DT), vectorized=True)
REGULATOR = ILQR([1.0, 0.1], [0.01], [10.0, 1.0], tolerance=1e-12)


def swing(horizon: int = 15, start: object = np.pi, goal: object = 1.0) -> Task:
    return Task([start, 0.0], goal=[goal, 0.0], horizon=horizon, dt=DT)


def random_linear(seed: int, batch: tuple[int, ...] = (), n: int = 3, m: int = 2) -> tuple[Linear, Task]:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 1.05 / np.abs(np.linalg.eigvals(A)).max()
    task = Task(rng.normal(size=(*batch, n)), horizon=12, dt=DT, reference=rng.normal(size=(*batch, 13, n)))
    return Linear(A, rng.normal(size=(n, m)), rng.normal(size=n)), task


def cost_of(inputs: np.ndarray, task: Task, model: Model = PENDULUM, settings: ILQR = REGULATOR) -> float:
    """Return the cost of an open-loop input sequence, written out."""
    x, total, cost = task.initial_state, 0.0, settings.cost
    for t, u in enumerate(inputs):
        gap = x - task.reference[t]
        total += 0.5 * gap @ cost.Q @ gap + 0.5 * u @ cost.R @ u
        x = model.step(x, u)
    gap = x - task.reference[-1]
    return float(total + 0.5 * gap @ cost.Q_final @ gap)


def gradient_of(inputs: np.ndarray, task: Task, h: float = 1e-5) -> np.ndarray:
    moves = h * np.eye(inputs.size).reshape(-1, *inputs.shape)
    return np.array([(cost_of(inputs + e, task) - cost_of(inputs - e, task)) / (2 * h) for e in moves])


def textbook_riccati(model: Linear, task: Task, Q: np.ndarray, R: np.ndarray, Q_final: np.ndarray) -> np.ndarray:
    """Return the optimal states, on the state that is augmented by a constant 1 and the reference taken from it."""
    n, horizon = len(Q), task.horizon
    A = np.block([[model.A, model.c[:, None]], [np.zeros((1, n)), np.ones((1, 1))]])
    B = np.vstack([model.B, np.zeros((1, model.B.shape[1]))])
    track = [np.hstack([np.eye(n), -r[:, None]]) for r in task.reference]
    P, gains = track[-1].T @ Q_final @ track[-1], []
    for t in reversed(range(horizon)):
        gains.append(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))
        P = track[t].T @ Q @ track[t] + A.T @ P @ (A - B @ gains[-1])
    states = [np.append(task.initial_state, 1.0)]
    for gain in reversed(gains):
        states.append((A - B @ gain) @ states[-1])
    return np.array(states)[:, :n]


def rounded_step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the step of the pendulum in single precision, whose rounding stops iLQR before it converges."""
    return rk4(derivative, DT)(x.astype(np.float32), u.astype(np.float32)).astype(np.float32)


def riccati_gains(solution: ILQRSolution, model: Model, settings: ILQR, task: Task) -> np.ndarray:
    """Return the gains of the Riccati recursion along a solution of one task, from differences of the model."""
    controller, cost, h = solution.controller, settings.cost, 2e-3
    P, gains = cost.Q_final, []
    for x, u in zip(controller.states[::-1], controller.inputs[::-1], strict=True):
        z, n = np.concatenate([x, u]), len(x)
        moves = h * np.eye(len(z))
        F = np.stack(
            [(model.step(*np.split(z + e, [n])) - model.step(*np.split(z - e, [n]))) / (2 * h) for e in moves], axis=-1
        )
        A, B = F[:, :n].astype(float), F[:, n:].astype(float)
        gains.append(-np.linalg.solve(cost.R + B.T @ P @ B, B.T @ P @ A))
        P = cost.Q + A.T @ P @ (A + B @ gains[-1])
    return np.array(gains[::-1])


@pytest.mark.parametrize("goal", [0.5, 1.0, 2.0])
@pytest.mark.parametrize(
    ("model", "settings"),
    [
        (Function(rounded_step, vectorized=True), REGULATOR),
        (PENDULUM, ILQR([1.0, 0.1], [0.01], [10.0, 1.0], iterations=1)),
        (PENDULUM, ILQR([1.0, 0.1], [0.01], [10.0, 1.0], iterations=2)),
    ],
)
def test_the_gains_of_a_design_that_did_not_converge_are_those_of_an_undamped_step(
    model: Model, settings: ILQR, goal: float
) -> None:
    task = swing(goal=goal)
    solution = settings.solve(task, model)
    assert not solution.converged
    expected = riccati_gains(solution, model, settings, task)
    np.testing.assert_allclose(solution.controller.gains, expected, rtol=0, atol=0.01 * np.abs(expected).max())


def test_the_gains_hardly_depend_on_where_rounding_stops_the_iteration() -> None:
    model, goals = Function(rounded_step, vectorized=True), 1 + 1e-9 * np.arange(20)
    zeros = np.zeros(20)
    start, goal = np.stack([zeros + np.pi, zeros], axis=-1), np.stack([goals, zeros], axis=-1)
    limited = ILQR([1.0, 0.1], [0.01], [10.0, 1.0], limits=12.0, tolerance=1e-12)
    solution = limited.solve(Task(start, goal=goal, horizon=15, dt=DT), model)
    assert not solution.converged.all()
    gains = solution.controller.gains
    np.testing.assert_allclose(gains, np.broadcast_to(gains[0], gains.shape), rtol=0, atol=0.02 * np.abs(gains).max())
    for k in (0, 7):
        alone = limited.solve(swing(goal=goals[k]), model)
        assert alone.converged == solution.converged[k]
        np.testing.assert_allclose(alone.controller.gains, gains[k], rtol=0, atol=1e-3 * np.abs(gains).max())


class Fails:
    """The pendulum, whose Jacobian is not finite beyond an angle."""

    def __init__(self, angle: float) -> None:
        self._angle = angle

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return PENDULUM.step(x, u)

    def jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A, B = linearize(PENDULUM, x, u)
        return np.where((x[..., :1, None] < self._angle), np.nan, A), B


def test_if_no_undamped_step_is_possible_the_gains_of_the_last_accepted_step_remain() -> None:
    settings = ILQR([1.0, 0.1], [0.01], [10.0, 1.0], iterations=1)
    usual = settings.solve(swing(), PENDULUM)
    angle = float(usual.controller.states[:, 0].min())
    free = np.pi - 1e-3  # without input the pendulum stays near its start
    both = Task([[np.pi, np.pi], 0.0], goal=[[1.0, 3.0], 0.0], horizon=15, dt=DT)
    solution = settings.solve(both, Fails((angle + free) / 2))
    assert np.abs(solution.controller.gains[0]).max() > 0
    assert np.abs(solution.controller.gains[0] - usual.controller.gains).max() > 1e-3
    alone = settings.solve(both[1], PENDULUM)
    np.testing.assert_allclose(solution.controller.gains[1], alone.controller.gains, rtol=1e-9)


# On a linear model


@pytest.mark.parametrize("seed", range(5))
def test_on_a_linear_model_it_is_the_riccati_solution_after_one_iteration(seed: int) -> None:
    model, task = random_linear(seed)
    weights = np.diag([1.0, 0.5, 2.0]), np.diag([0.3, 1.0]), np.diag([5.0, 5.0, 5.0])
    solution = ILQR(*weights).solve(task, model)
    found = rollout(model.step, solution.controller, task)
    regulated = rollout(model.step, LQR(*weights).design(task, model), task)
    np.testing.assert_allclose(found.states, textbook_riccati(model, task, *weights), rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.states, regulated.states, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.inputs, regulated.inputs, rtol=0, atol=1e-10)
    np.testing.assert_allclose(solution.controller.gains, LQR(*weights).design(task, model).gains, rtol=0, atol=1e-10)
    assert (solution.iterations, solution.converged) == (1, True)


def test_on_a_linear_model_every_task_of_a_batch_needs_one_iteration() -> None:
    model, task = random_linear(0, batch=(2, 4))
    solution = ILQR(np.ones(3), np.ones(2)).solve(task, model)
    np.testing.assert_array_equal(solution.iterations, np.ones((2, 4)))
    assert solution.converged.all()
    regulated = rollout(model.step, LQR(np.ones(3), np.ones(2)).design(task, model), task)
    found = rollout(model.step, solution.controller, task)
    np.testing.assert_allclose(found.states, regulated.states, rtol=0, atol=1e-10)


def test_where_nothing_is_to_gain_it_has_arrived_at_once() -> None:
    model = Linear(0.9 * np.eye(2), np.ones((2, 1)))
    solution = ILQR([1, 1], [1]).solve(Task([[0.0, 1.0], 0.0], goal=[0, 0], horizon=5, dt=DT), model)
    assert solution.iterations.tolist() == [0, 1]
    assert solution.cost[0] == 0
    assert solution.converged.all()


def test_on_an_unstable_linear_model_rounding_is_iterated_away() -> None:
    # Without input the states grow by 1.5^100 = 4e17, so one step leaves an error of the size of the states.
    model = Linear([[1.5, 0.1], [0.0, 1.35]], [[0.0], [1.0]], [0.3, -0.2])
    task = Task([[1.0, 0.1], -1.0], goal=[0.5, 0.5], horizon=100, dt=DT)
    solution = ILQR([1, 1], [1]).solve(task, model)
    found = rollout(model.step, solution.controller, task)
    regulated = rollout(model.step, LQR([1, 1], [1]).design(task, model), task)
    assert solution.converged.all()
    np.testing.assert_allclose(found.states, regulated.states, rtol=0, atol=1e-6)


class Bare:
    """A linear model of which only the steps are seen."""

    def __init__(self, model: Linear) -> None:
        self._model = model

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return self._model.step(x, u)


def test_a_linear_model_without_a_jacobian_gives_the_same_trajectories() -> None:
    model, task = random_linear(1)
    regulator = ILQR(np.ones(3), np.ones(2), tolerance=1e-12)
    with_, without = (rollout(model.step, regulator.design(task, m), task) for m in (model, Bare(model)))
    np.testing.assert_allclose(without.states, with_.states, rtol=0, atol=1e-6)


# On a nonlinear model


@pytest.mark.parametrize("goal", [-1.0, 0.0, 3.0, *more(-2.5, 1.0, 2.0)])
def test_the_solution_is_a_stationary_point_and_a_minimum_of_the_cost(goal: float) -> None:
    task = swing(goal=goal)
    solution = REGULATOR.solve(task, PENDULUM)
    inputs = solution.controller.inputs
    assert solution.converged
    start = np.abs(gradient_of(np.zeros_like(inputs), task)).max()
    assert np.abs(gradient_of(inputs, task)).max() <= 1e-5 * start
    rng = np.random.default_rng(0)
    nearby = [cost_of(inputs + 0.05 * rng.normal(size=inputs.shape), task) for _ in range(20)]
    assert min(nearby) > solution.cost


@pytest.mark.parametrize("goal", [0.5, *more(-1.0, 2.0)])
def test_no_general_optimiser_finds_a_lower_cost_from_the_same_start(goal: float) -> None:
    task = swing(horizon=6, goal=goal)
    solution = REGULATOR.solve(task, PENDULUM)
    general = minimize(
        lambda u: cost_of(u.reshape(6, 1), task),
        np.zeros(6),
        jac=lambda u: gradient_of(u.reshape(6, 1), task, 1e-6),
        method="BFGS",
        options={"gtol": 1e-6},
    )
    assert solution.cost <= general.fun * (1 + 1e-7)


def test_the_reported_cost_is_that_of_the_closed_loop() -> None:
    task = swing(goal=np.linspace(-2, 2, 5))
    solution = REGULATOR.solve(task, PENDULUM)
    loop = rollout(PENDULUM.step, solution.controller, task)
    np.testing.assert_allclose(loop.inputs, solution.controller.inputs, rtol=0, atol=1e-8)
    costs = [cost_of(loop.inputs[i], task[i]) for i in range(5)]
    np.testing.assert_allclose(solution.cost, costs, rtol=1e-8)


@pytest.mark.parametrize(("R", "Q_final"), [(0.01, [10.0, 1.0]), (3.0, [1000.0, 100.0])])
def test_no_iteration_raises_the_cost(R: float, Q_final: list[float]) -> None:
    # With a heavy last state and costly torque, full steps overshoot: without a line search the cost would rise.
    task = swing(horizon=40, goal=np.linspace(-3, 3, 7))
    settings = [ILQR([1.0, 0.1], [R], Q_final, iterations=limit) for limit in range(1, 9)]
    costs = [[cost_of(np.zeros((40, 1)), task[i], settings=settings[0]) for i in range(7)]]
    for regulator in settings:
        solution = regulator.solve(task, PENDULUM)
        assert (solution.iterations <= regulator.iterations).all()
        costs.append(solution.cost)
    assert (np.diff(costs, axis=0) <= 1e-9).all()
    assert (np.array(costs[-1]) < 0.7 * np.array(costs[0])).all()


def test_the_limit_of_iterations_is_kept_and_told() -> None:
    solution = ILQR([1.0, 0.1], [0.01], iterations=2).solve(swing(goal=[0.0, np.pi]), PENDULUM)
    # The second task starts at rest in its goal, where the rod hangs without torque.
    assert solution.iterations.tolist() == [2, 0]
    assert solution.converged.tolist() == [False, True]


def test_the_feedback_corrects_a_disturbed_start() -> None:
    task = swing(horizon=40, goal=0.0, start=0.3)
    controller = REGULATOR.design(task, PENDULUM)
    disturbed = Task([0.35, 0.0], goal=[0.0, 0.0], horizon=40, dt=DT)
    closed = rollout(PENDULUM.step, controller, disturbed)
    opened = rollout(PENDULUM.step, lambda t, x: controller.inputs[t], disturbed)
    assert abs(closed.final_state[0]) < 0.01
    assert abs(opened.final_state[0]) > 1.0


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
def test_a_batch_of_tasks_is_the_loop_over_them(batch: tuple[int, ...]) -> None:
    goals = np.linspace(-2.5, 2.5, 6).reshape(batch)
    task = swing(horizon=20, goal=goals)
    whole = REGULATOR.solve(task, PENDULUM)
    for i in np.ndindex(batch):
        alone = REGULATOR.solve(swing(horizon=20, goal=goals[i]), PENDULUM)
        assert whole.iterations[i] == alone.iterations
        assert whole.converged[i] == alone.converged
        np.testing.assert_allclose(whole.cost[i], alone.cost, rtol=1e-10)
        for name in ("gains", "inputs", "states"):
            ours, theirs = getattr(whole.controller, name)[i], getattr(alone.controller, name)
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_step_lengths_tried_together_are_those_tried_one_after_the_other() -> None:
    # With a heavy last state and costly torque, full steps overshoot. A plain function is tried with one length a call.
    task = swing(horizon=20, goal=np.linspace(-3, 3, 4))
    regulator = ILQR([1.0, 0.1], [3.0], [1000.0, 100.0])
    together = regulator.solve(task, PENDULUM)
    one_by_one = regulator.solve(task, Function(PENDULUM.step))
    np.testing.assert_array_equal(together.iterations, one_by_one.iterations)
    np.testing.assert_allclose(together.cost, one_by_one.cost, rtol=1e-10)
    np.testing.assert_allclose(together.controller.inputs, one_by_one.controller.inputs, rtol=0, atol=1e-7)


class Steered:
    """x' = f(x) + B u with its own Jacobians, of which the constant ones come without batch axes."""

    def __init__(self, A: bool, B: bool) -> None:
        self.constant_A, self.constant_B = A, B

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        drift = np.zeros_like(x[..., 0]) if self.constant_A else np.sin(x[..., 0])
        push = u[..., 0] if self.constant_B else (1 + 0.3 * np.tanh(u[..., 0])) * u[..., 0]
        return x + DT * np.stack([x[..., 1], drift + push], axis=-1)

    def jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A = np.array([[1, DT], [0, 1]]) if self.constant_A else np.tile([[1, DT], [0, 1.0]], (*x.shape[:-1], 1, 1))
        if not self.constant_A:
            A[..., 1, 0] = DT * np.cos(x[..., 0])
        if self.constant_B:
            return A, np.array([[0], [DT]])
        v = u[..., 0]
        slope = 1 + 0.3 * np.tanh(v) + 0.3 * v / np.cosh(v) ** 2
        return A, np.stack([np.zeros_like(v), DT * slope], axis=-1)[..., None]


@pytest.mark.parametrize(("A", "B"), [(False, True), (True, False), (False, False)])
@pytest.mark.parametrize("goal", [0.5, np.linspace(-1, 1, 3)])
def test_a_jacobian_may_leave_out_the_batch_axes_of_what_is_constant(A: bool, B: bool, goal: object) -> None:
    model, task = Steered(A, B), swing(start=1.0, goal=goal)
    own, numeric = REGULATOR.solve(task, model), REGULATOR.solve(task, Function(model.step, vectorized=True))
    np.testing.assert_allclose(own.controller.inputs, numeric.controller.inputs, rtol=0, atol=1e-4)
    np.testing.assert_allclose(own.cost, numeric.cost, rtol=1e-8)
    assert own.converged.all()


class Counting:
    """A model that refuses to be stepped for ever."""

    def __init__(self, gravity: float, limit: int) -> None:
        self.gravity, self.left = gravity, limit

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("the descent does not end")
        push = self.gravity * np.sin(3 * x[..., 0]) + 3 * np.tanh(u[..., 0])
        return x + 0.1 * np.stack([x[..., 1], push], axis=-1)


def test_where_no_step_improves_the_cost_it_ends_unconverged() -> None:
    # Undamped steps are refused by the line search, and damped ones promise less than the tolerance.
    model, scale = Counting(gravity=72.31301315438255, limit=20_000), 1.3012535082140208e-07
    regulator = ILQR([scale, 0.1 * scale], [scale * 8.88478711261551e-08], tolerance=9.099141069810077e-05)
    solution = regulator.solve(Task([np.pi, 0.0], goal=[1.05207762, 0.0], horizon=13, dt=0.1), model)
    assert not solution.converged
    assert np.isfinite(solution.cost)


# What is refused


def test_a_model_that_diverges_without_input_is_refused() -> None:
    explosive = Function(lambda x, u: x**3 + u, vectorized=True)
    with refuses(DesignError, "horizon"):
        ILQR([1], [1]).design(Task([10.0], horizon=50, dt=DT), explosive)


def test_a_model_whose_jacobian_is_not_finite_is_refused() -> None:
    kinked = Function(lambda x, u: np.sqrt(x) + u, vectorized=True)
    with refuses(ModelError, "Jacobian"):
        ILQR([1], [1]).design(Task([0.0], goal=[1.0], horizon=5, dt=DT), kinked)


@pytest.mark.parametrize(
    ("weights", "facts"),
    [
        (([1, -1], [1]), ("Q", [1.0, 0.0], [0.0, -1.0])),
        (([1, 1], [0]), ("R", [0.0])),
        (([1, 1], [np.inf]), ("R",)),
        (([1, 1], [1], [1, 1, 1]), ("Q_final", (2, 2), (3, 3))),
    ],
)
def test_bad_weights_are_refused_by_value(weights: tuple[object, ...], facts: tuple[object, ...]) -> None:
    with refuses((InputError, ShapeError), *facts):
        ILQR(*weights)


@pytest.mark.parametrize("limits", [{"iterations": 0}, {"tolerance": 0.0}, {"tolerance": np.nan}])
def test_a_limit_that_is_not_positive_is_refused_by_value(limits: dict[str, float]) -> None:
    with refuses(InputError, next(iter(limits.values()))):
        ILQR([1, 1], [1], **limits)


def test_a_task_with_other_states_than_the_weights_is_refused() -> None:
    with refuses(ShapeError, "Q", 2, (1, 1)):
        ILQR([1], [1]).design(swing(), PENDULUM)
