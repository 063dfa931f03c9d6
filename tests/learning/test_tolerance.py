from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Transitions, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.rollout import rollout
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.dynamics_posterior import DynamicsPosterior, PosteriorSettings, learn_posterior
from ctxval.learning.tolerance import LEVELS, push_response

A, B = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.0], [0.1]])
TASKS = np.linspace(0.05, 0.95, 7)[:, None]
LABELS = ("place [m]", "speed [m/s]", "u[0]")


@pytest.fixture(scope="module")
def planner() -> LoopPlanner:
    return LoopPlanner(
        Validation(
            space=TaskSpace(goal=(-1.0, 1.0, "m")),
            task=lambda p: Task(
                np.zeros((*p.goal.shape, 2)), goal=np.stack([p.goal, 0 * p.goal], -1), horizon=20, dt=0.1
            ),
            system=systems.Simulated(lambda x, u: x, vectorized=True),
            model=models.Linear(A, B),
            synthesizer=controllers.LQR([5.0, 1.0], [0.1]),
            distance=distances.FinalState(components=[0]),
        )
    )


def learn(planner: LoopPlanner, x: Array, u: Array) -> DynamicsPosterior:
    """Learn from transitions with a drag that M misses, in the second state alone."""
    x_next = x @ A.T + u @ B.T - 0.01 * np.tanh(x[:, 1:]) * [0.0, 1.0]
    settings = PosteriorSettings(hyperparameters=2, functions=1)
    data, sources = Transitions(x, u, x_next), np.zeros(len(x), dtype=np.intp)
    posterior = learn_posterior(planner.validation.model, data, sources, settings=settings)
    assert posterior is not None
    return posterior


@pytest.fixture(scope="module")
def posterior(planner: LoopPlanner) -> DynamicsPosterior:
    rng = np.random.default_rng(1)
    return learn(planner, rng.normal(size=(40, 2)), rng.normal(size=(40, 1)))


def test_pushes_are_those_of_single_rollouts(planner: LoopPlanner, posterior: DynamicsPosterior) -> None:
    response, mean = push_response(planner, posterior, TASKS, LABELS), posterior.mean
    (planned,) = planner.plan(TASKS)
    residual = response.residuals["speed [m/s^2]"] * planned.task.dt
    largest = []
    for level in LEVELS:
        for push in (level * residual, -level * residual):
            step = lambda x, u, push=push: mean.step(x, u) + push * np.array([0.0, 1.0])  # noqa: E731
            largest.append(planner.compared(planned, rollout(step, planned.controller, planned.task)).max())
    assert list(response.residuals) == ["speed [m/s^2]"]
    of_each = np.array(largest).reshape(-1, 2).max(axis=1)
    np.testing.assert_allclose(response.everywhere[0], np.maximum.accumulate(of_each), rtol=1e-9)


def test_the_largest_residual_is_that_of_the_records(planner: LoopPlanner, posterior: DynamicsPosterior) -> None:
    speeds = np.random.default_rng(1).normal(size=(40, 2))[:, 1]
    response = push_response(planner, posterior, TASKS, LABELS)
    assert response.residuals["speed [m/s^2]"] == pytest.approx(0.01 * np.abs(np.tanh(speeds)).max() / 0.1, rel=1e-6)


def test_a_larger_push_never_has_a_smaller_distance(planner: LoopPlanner, posterior: DynamicsPosterior) -> None:
    response = push_response(planner, posterior, TASKS, LABELS)
    for distances_of in (response.everywhere, response.away):
        assert (np.diff(distances_of, axis=1) >= 0).all()


def test_nothing_pushes_where_records_are_near(planner: LoopPlanner) -> None:
    at = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 61), np.linspace(-2.0, 2.0, 61)), -1).reshape(-1, 2)
    covered = learn(planner, at, np.zeros((len(at), 1)))
    undisturbed = planner.distances(covered.mean, planner.plan(TASKS), len(TASKS)).max()
    response = push_response(planner, covered, TASKS, LABELS)
    np.testing.assert_allclose(response.away, undisturbed)
    assert (response.everywhere[:, -1] > 1.5 * undisturbed).all()


def test_away_from_records_a_push_acts_as_everywhere(planner: LoopPlanner) -> None:
    rng = np.random.default_rng(2)
    far = learn(planner, 50 + rng.normal(size=(40, 2)), rng.normal(size=(40, 1)))
    response = push_response(planner, far, TASKS, LABELS)
    np.testing.assert_allclose(response.away, response.everywhere)
