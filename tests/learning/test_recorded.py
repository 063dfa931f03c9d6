"""Which recorded transitions the dynamics are learned from, and the closed loops that show which are needed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Task, TaskSpace, Trajectory, Transitions, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.errors import DesignError
from ctxval.learning import PosteriorSettings
from ctxval.learning.recorded import Memories, closed_loops_on_model, data_near, recorded_transitions

A, B = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]]
LQR = controllers.LQR([1.0, 0.1], [0.1])
MOST, MOST_OF_MODEL = 3000, 600

MODEL = models.Linear(np.eye(2), np.ones((2, 1)))


def make_validation(synthesizer: Any = LQR, model: Any = None) -> Validation:
    return Validation(
        space=TaskSpace(start=([-2.0, -1.0], [2.0, 1.0])),
        task=lambda p: Task(p.start, goal=[0.3, 0.0], horizon=12, dt=0.1),
        system=systems.Simulated(models.Linear(A, B)),
        model=model or models.Linear(A, B),
        synthesizer=synthesizer,
        distance=distances.MeanDeviation(),
    )


def executions(count: int) -> list[Trajectory]:
    found = make_validation()
    points = np.random.default_rng(1).random((count, 2))
    return [found.outcome(found.space.from_unit(point)).system_trajectory for point in points]


def loops() -> Trajectory:
    found = closed_loops_on_model(make_validation())
    assert found is not None
    return found


def data(count: int, spread: float = 1.0) -> Transitions:
    rng = np.random.default_rng(2)
    x, u = spread * rng.normal(size=(count, 2)), spread * rng.normal(size=(count, 1))
    return Transitions(x, u, models.Linear(A, B).step(x, u))


def rows_of(transitions: Transitions) -> Array:
    return np.concatenate([transitions.x, transitions.u, transitions.x_next], axis=1)


class Refusing:
    """LQR that designs a controller for a share of the tasks, one at a time."""

    def __init__(self, low: float) -> None:
        self.low = low

    def design(self, task: Task, model: models.Model) -> Controller:
        if task.initial_state[0] < self.low:
            raise DesignError("there is no controller")
        return LQR.design(task, model)


class Batched(Refusing):
    """The same for batches, which fail as a whole."""

    batched = True

    def design(self, task: Task, model: models.Model) -> Controller:
        if task.batch_shape:
            raise DesignError("no batches here")
        return super().design(task, model)


def test_nothing_is_known_without_executions_and_data() -> None:
    assert recorded_transitions(MODEL, None, [], loops()) is None


@given(st.integers(1, 4))
def test_each_transition_has_the_number_of_its_execution(count: int) -> None:
    executed = executions(count)
    found = recorded_transitions(MODEL, None, executed, loops())
    assert found is not None
    transitions, sources = found
    np.testing.assert_array_equal(sources, np.repeat(np.arange(count), 12))
    for k, trajectory in enumerate(executed):
        own = sources == k
        np.testing.assert_array_equal(transitions.x[own], trajectory.states[:-1])
        np.testing.assert_array_equal(transitions.u[own], trajectory.inputs)
        np.testing.assert_array_equal(transitions.x_next[own], trajectory.states[1:])


def test_the_data_of_the_model_have_no_execution() -> None:
    own = data(50)
    found = recorded_transitions(MODEL, data_near(models.Linear(A, B, data=own), loops()), executions(1), loops())
    assert found is not None
    transitions, sources = found
    np.testing.assert_array_equal(sources, [*[0] * 12, *[-1] * 50])
    np.testing.assert_array_equal(transitions.x[12:], own.x)


def test_of_many_data_those_near_the_closed_loops_are_kept() -> None:
    near, far = data(MOST_OF_MODEL, 0.1), data(400, 0.1)
    everything = Transitions.joined([Transitions(far.x + 50, far.u + 50, far.x_next + 50), near])
    found = recorded_transitions(MODEL, data_near(models.Linear(A, B, data=everything), loops()), [], loops())
    assert found is not None
    np.testing.assert_array_equal(rows_of(found[0]), rows_of(near))


def test_if_all_closed_loops_diverge_all_data_are_kept() -> None:
    own = data(MOST_OF_MODEL + 100)
    diverged = loops()
    infinite = Trajectory(diverged.times, np.full_like(diverged.states, np.inf), diverged.inputs)
    found = recorded_transitions(MODEL, data_near(models.Linear(A, B, data=own), infinite), [], infinite)
    assert found is not None
    assert len(found[0]) == len(own)


def test_of_very_many_transitions_a_random_part_is_kept_and_it_is_always_the_same() -> None:
    executed = executions(1) * 300
    first, second = (recorded_transitions(MODEL, None, executed, loops()) for _ in range(2))
    assert first is not None
    assert second is not None
    assert len(first[0]) == MOST
    assert len(first[1]) == MOST
    assert (np.diff(first[1]) >= 0).all()
    assert len(set(first[1])) > 280
    np.testing.assert_array_equal(first[1], second[1])
    np.testing.assert_array_equal(rows_of(first[0]), rows_of(second[0]))


def test_closed_loops_on_the_model_are_those_of_random_tasks() -> None:
    found = make_validation()
    together = closed_loops_on_model(found)
    assert together is not None
    assert together.batch_shape == (64,)
    start = together.states[5, 0]
    task = found.task(found.space.parameters(start))
    np.testing.assert_allclose(
        together.states[5], rollout(found.model.step, LQR.design(task, found.model), task).states, atol=1e-12
    )


@pytest.mark.parametrize("kind", [Refusing, Batched])
def test_one_closed_loop_is_enough_if_there_can_be_no_batch(kind: type[Refusing]) -> None:
    found = closed_loops_on_model(make_validation(kind(-2.5)))
    assert found is not None
    assert found.batch_shape == ()


def test_a_task_without_a_controller_is_passed_over() -> None:
    points = make_validation().space.from_unit(np.random.default_rng(0).random((64, 2)))[:3]
    low = float(np.sort(points[:, 0])[-1])  # a controller for one of the three tasks that are tried
    found = closed_loops_on_model(make_validation(Refusing(low)))
    assert found is not None
    assert found.states[0, 0] == low
    assert closed_loops_on_model(make_validation(Refusing(2.5))) is None


def test_logs_are_known_transitions_whose_numbers_follow_those_of_executions() -> None:
    rng = np.random.default_rng(0)

    def walk(steps: int) -> Trajectory:
        return Trajectory(np.arange(steps + 1.0), rng.normal(size=(steps + 1, 2)), rng.normal(size=(steps, 1)))

    executed, logged, loops = walk(5), [walk(4), walk(3)], walk(6)
    found = recorded_transitions(MODEL, None, [executed], loops, logged)
    assert found is not None
    assert found[1].tolist() == [0] * 5 + [1] * 4 + [2] * 3
    np.testing.assert_array_equal(found[0].x[5:9], logged[0].states[:-1])


def test_of_long_logs_the_steps_near_the_tasks_are_kept() -> None:
    rng = np.random.default_rng(0)
    states = np.cumsum(rng.normal(size=(5001, 1)), axis=0)
    log = Trajectory(np.arange(5001.0), states, np.zeros((5000, 1)))
    loops = Trajectory(np.arange(3.0), np.full((3, 1), states[100, 0]), np.zeros((2, 1)))
    found = recorded_transitions(MODEL, None, [], loops, [log])
    assert found is not None
    gaps = np.abs(states[:-1, 0] - states[100, 0])
    np.testing.assert_array_equal(np.sort(np.abs(found[0].x[:, 0] - states[100, 0])), np.sort(gaps)[: len(found[0])])
    assert len(found[0]) == 1500


def test_long_loops_have_fewer_centres_within_limits() -> None:
    centres = [PosteriorSettings.for_horizon(horizon).centres for horizon in (10, 100, 1000)]
    assert centres == [400, 300, 150]


def test_of_very_many_transitions_those_near_the_tasks_are_taken_in_little_memory() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(200_000, 2)), rng.normal(size=(200_000, 1))
    many = Transitions(x, u, x @ np.array(A).T + u @ np.array(B).T)
    few = many[:20_000]
    near = data_near(models.Linear(A, B, data=many), loops())
    of_few = data_near(models.Linear(A, B, data=few), loops())
    assert near is not None
    assert of_few is not None
    assert len(near) == len(of_few) == 600
    known = np.concatenate([loops().transitions().x, loops().transitions().u], axis=1)

    def farthest(of: Transitions) -> float:
        pairs = np.concatenate([of.x, of.u], axis=1)
        return float(np.sqrt(((pairs[:, None] - known[::7]) ** 2).sum(axis=2)).min(axis=1).max())

    assert farthest(near) < farthest(of_few)


class Accumulating:
    """A model with memory that counts how often it is followed."""

    def __init__(self) -> None:
        self.steps = 0

    def step(self, x: Array, u: Array) -> Array:
        return x + u

    def start(self, x: Array) -> Array:
        return np.zeros((*x.shape[:-1], 1))

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        self.steps += 1
        return x + u + memory, memory + 1.0


def test_a_model_is_followed_once_along_each_recording() -> None:
    model, known = Accumulating(), Memories()
    first, second = (Trajectory(np.arange(4.0), np.full((4, 1), k), np.zeros((3, 1))) for k in (0.0, 1.0))
    for recorded in (first, second, first):
        assert known.of(model, recorded).memory is not None
    assert model.steps == 6
    assert np.isnan(known.of(model, first, started=False).memory).any()  # type: ignore[arg-type]
    assert model.steps == 9
    np.testing.assert_array_equal(known.of(model, first).memory, [[0.0], [1.0], [2.0]])  # type: ignore[arg-type]
    other = Accumulating()
    known.of(other, first)
    assert other.steps == 3
