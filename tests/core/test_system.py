from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Campaign, Task, Trajectory, distances, systems
from ctxval.core.rollout import rollout
from ctxval.core.system import Outputs, as_outputs
from ctxval.errors import InputError, ModelError, ShapeError, StoreMismatchError
from ctxval.models import Linear
from ctxval.systems import Simulated, System, rk4
from ctxval.testing import check_system
from facts import refuses
from rig_outputs import DT, H, swing, swing_validation


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


# Outputs in place of states: what controllers, distances and records see


# Outputs alone


def test_outputs_are_indices_or_a_function_of_one_state_or_of_many() -> None:
    x = np.arange(24.0).reshape(2, 4, 3)
    assert Outputs([2, 0])(x).tolist() == x[..., [2, 0]].tolist()
    many = Outputs(lambda x: np.stack([x[..., 0] + x[..., 1]], axis=-1))
    one = Outputs(lambda x: np.array([float(x[0]) + float(x[1])]))
    assert one(x[:1, :1]).tolist() == many(x[:1, :1]).tolist() == [[[1.0]]]
    assert many(x).tolist() == one(x).tolist()
    assert one(x[0, 0]).tolist() == [1.0]
    assert not as_outputs(None).hide_states
    assert as_outputs(many) is many


@pytest.mark.parametrize("given", [[], [0, 0], [-1]])
def test_indices_must_be_different_ones_from_0(given: list[int]) -> None:
    with refuses(InputError, "outputs"):
        Outputs(given)


def test_indices_must_be_those_of_states() -> None:
    with refuses(InputError, "outputs", 2, [2]):
        swing_validation(outputs=(2,), task=lambda p: Task([0.2, 0.0], horizon=H, dt=DT)).plan([0.5])


@pytest.mark.parametrize("function", [lambda x: 1.0, lambda x: np.zeros((2, 2))])
def test_a_function_of_another_shape_is_refused(function: Any) -> None:
    with refuses(ShapeError, "state"):
        Outputs(function)(np.zeros(3))


def test_a_function_that_fails_is_an_error_in_one_sentence() -> None:
    with refuses(InputError, "outputs", "ZeroDivisionError"):
        swing_validation(outputs=lambda x: [1 / 0]).plan([0.5])


@pytest.mark.parametrize("p", [1, 2, 4])
def test_the_jacobian_is_that_of_the_function(p: int) -> None:
    weights = np.random.default_rng(p).normal(size=(p, 3))
    x = np.random.default_rng(0).normal(size=(5, 3))
    C = Outputs(lambda x: np.sin(x @ weights.T)).jacobian(x)
    assert pytest.approx(np.cos(x @ weights.T)[..., None] * weights, abs=1e-8) == C
    assert Outputs([2, 0]).jacobian(x)[3].tolist() == [[0, 0, 1], [1, 0, 0]]


# In a validation


def test_trajectories_have_the_outputs_and_distances_are_those_of_the_states() -> None:
    of_outputs, of_states = swing_validation(), swing_validation(outputs=None)
    plan, points = of_outputs.plan([0.7]), np.linspace(-1, 1, 7)[:, None]
    assert plan.model_trajectory.states.shape == (H + 1, 1)
    assert plan.model_trajectory.states[:, 0].tolist() == of_states.plan([0.7]).model_trajectory.states[:, 0].tolist()
    assert of_outputs.distances(points) == pytest.approx(of_states.distances(points), abs=1e-12)
    assert of_outputs.batched
    alone = [of_outputs.outcome(point).distance for point in points]
    assert of_outputs.distances(points) == pytest.approx(alone, abs=1e-12)


@dataclass(frozen=True)
class Remembering:
    """Feedback of the angle and of its last change, whose memory begins with the initial state of M."""

    def design(self, task: Task, model: Any) -> Any:
        return self

    def start(self, task: Task) -> np.ndarray:
        assert task.initial_state.shape[-1] == 2
        return np.array(task.initial_state[..., :1])

    def step(self, t: int, y: np.ndarray, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert y.shape[-1] == 1
        return -y - 10 * (y - memory), y


def test_a_system_may_have_other_states_than_the_model() -> None:
    def slow_motor(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        motor = x[..., 2:] + 0.5 * (u - x[..., 2:])
        return np.concatenate([swing(0.4)(x[..., :2], motor), motor], axis=-1)

    def start(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x, np.zeros((*x.shape[:-1], 1))], axis=-1)

    slow = systems.WithOutputs(systems.Simulated(slow_motor, vectorized=True), [0], start=start)
    validation = swing_validation(system=slow, synthesizer=Remembering())
    outcome = validation.outcome([0.7])
    assert outcome.system_trajectory.states.shape == (H + 1, 1)
    assert 0 < outcome.distance < 1
    check_system(slow, outcome.plan.controller, outcome.plan.task, outputs=[0])


def test_batches_of_outputs_are_exact_if_those_of_the_system_are_and_no_function_is_called() -> None:
    class Exact(systems.Simulated):
        exact_batches = True

    exact, rounded = Exact(swing(0.4), vectorized=True), systems.Simulated(swing(0.4), vectorized=True)
    assert systems.WithOutputs(exact, [0]).exact_batches
    assert not systems.WithOutputs(rounded, [0]).exact_batches
    assert not systems.WithOutputs(exact, lambda x: x[..., :1]).exact_batches
    assert not systems.WithOutputs(exact, [0], start=lambda x: x).exact_batches


@pytest.mark.parametrize("goal", [[0.3, 0.0], [0.3, 0.0, 0.0]])
def test_goals_are_outputs(goal: list[float]) -> None:
    validation = swing_validation(task=lambda p: Task([0.2, 0.0], goal=goal, horizon=H, dt=DT))
    with refuses(ShapeError, "task", 1, len(goal)):
        validation.plan([0.5])


def test_an_execution_starts_at_the_outputs_of_the_initial_state() -> None:
    validation = swing_validation()
    plan = validation.plan([0.7])
    late = Trajectory(plan.task.times, plan.model_trajectory.states + 0.3, plan.model_trajectory.inputs)
    with refuses(InputError, 0, 0.2, 0.5):
        validation.require(plan, late)


def test_a_model_whose_loop_diverges_is_named() -> None:
    def away(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return 1e30 * x

    with refuses(ModelError, "model", "goal"):
        swing_validation(model=away).plan([0.5])


def test_m_in_the_place_of_s_has_outputs_too() -> None:
    on_model = swing_validation().on_model(distances.GoalError())
    assert on_model.is_on_model
    outcome = on_model.outcome([0.7])
    assert outcome.distance == pytest.approx(abs(outcome.plan.model_trajectory.states[-1, 0] - 0.7))


def test_a_store_belongs_to_its_outputs(tmp_path: Path) -> None:
    store = tmp_path / "a.sqlite"
    Campaign(swing_validation(), store=store, seed=0).run(1)
    assert Campaign(swing_validation(), store=store, seed=0).executions == 1
    with refuses(StoreMismatchError, "a.sqlite", "validation.system.outputs.of"):
        Campaign(swing_validation(outputs=lambda x: x[..., :1]), store=store, seed=0)


def test_what_needs_states_says_so() -> None:
    with refuses(InputError, "replay", "outputs"):
        swing_validation().require_states("a replay")
    swing_validation(outputs=None).require_states("a replay")


def test_a_step_that_raises_leaves_what_was_recorded_before() -> None:
    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        if x[0] > 0.25:
            raise RuntimeError("emergency stop")
        x += 0.1  # a step may change what it is given
        return x

    task = Task([0.0], goal=[1.0], horizon=8, dt=0.1)
    trajectory = systems.Simulated(step).execute(lambda t, x: np.array([float(t)]), task)
    assert trajectory.ended == "RuntimeError: emergency stop"
    np.testing.assert_allclose(trajectory.states[:, 0], [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(trajectory.inputs[:, 0], [0.0, 1.0, 2.0])
    with pytest.raises(RuntimeError):
        systems.Simulated(step).execute(lambda t, x: np.zeros(1), Task([1.0], goal=[1.0], horizon=8, dt=0.1))


@pytest.mark.parametrize("given", [["0", "1"], [True], [1.5], "01", [np.bool_(True)]])
def test_outputs_that_are_no_indices_are_refused(given: Any) -> None:
    with refuses(InputError, "outputs"):
        Outputs(given)
