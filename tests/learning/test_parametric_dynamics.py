"""Dynamics of a model with uncertain parameters: draws as systems, and verdicts from them."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, distances, models, systems
from ctxval.core.space import Parameters
from ctxval.core.trajectory import Trajectory
from ctxval.learning.dynamics_study import DynamicsStudy
from ctxval.learning.parametric_dynamics import (
    ParametricDraws,
    ParametricDynamics,
    ParametricPosterior,
    learned_parameters,
    rest_of,
)

TRUE = {"mass": 1.2, "drag": 0.3, "pull": 0.4}


def _mass_on_a_rail(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
    force = u[..., 0] - theta[1] * x[..., 1] + theta[2]
    rate = x[..., 1] + 0.05 * force / theta[0]
    return np.stack([x[..., 0] + 0.05 * rate, rate], axis=-1)


MODEL = models.Parametric(
    _mass_on_a_rail,
    {"mass": 1.0, "drag": 0.2, "pull": 0.0},
    uncertain={"mass": "20 %", "drag": 0.2, "pull": 0.5},
    vectorized=True,
)


class _Spring:
    """A feedback towards a goal, with a gain that is a task parameter."""

    batched = True

    def design(self, task: Task, model: object) -> object:
        goal = task.goal
        return lambda t, x: (4.0 * (goal[..., :1] - x[..., :1]) - 3.0 * x[..., 1:2]).clip(-8.0, 8.0)


def _task(p: Parameters) -> Task:
    values = p.points
    start = np.stack([0.0 * values[..., 0], values[..., 1]], axis=-1)
    goal = np.stack([values[..., 0], 0.0 * values[..., 0]], axis=-1)
    return Task(start, goal=goal, horizon=40, dt=0.05)


def _validation(hidden: float = 0.0, wall: float = np.inf) -> Validation:
    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        following = _mass_on_a_rail(x, u, np.array(list(TRUE.values())))
        following[..., 1] -= hidden * np.tanh(5 * x[..., 1])
        following[..., 1] *= following[..., 0] < wall
        following[..., 0] = np.minimum(following[..., 0], wall)
        return following

    return Validation(
        space=TaskSpace(goal=(-2.0, 2.0), rate=(-1.0, 1.0)),
        task=_task,
        system=systems.Simulated(step, vectorized=True),
        model=MODEL,
        synthesizer=_Spring(),
        distance=distances.MaximumDeviation(components=[0]),
    )


def _executions(validation: Validation, count: int) -> list[Trajectory]:
    points = validation.space.from_unit(np.random.default_rng(0).random((count, 2)))
    return [validation.outcome(point).system_trajectory for point in points]


def _learned(hidden: float = 0.0) -> tuple[ParametricPosterior, list[Trajectory]]:
    runs = _executions(_validation(hidden), 3)
    posterior = learned_parameters(MODEL, runs, runs[0], (0, 3, 0))
    assert posterior is not None
    return posterior, runs


def test_draws_run_together_as_each_alone() -> None:
    posterior, _ = _learned(hidden=0.02)
    rng = np.random.default_rng(0)
    draws = posterior.draw(np.empty((0, 0)), rng, 1, 5)
    x, u = rng.normal(size=(5, 3, 2)), rng.normal(size=(4, 5, 3, 1))
    together, memory = [x], draws.start(x)
    for inputs in u:
        following, memory = draws.advance(together[-1], inputs, memory)
        together.append(following)
    for k in range(5):
        alone, memory = x[k : k + 1], draws[k].start(x[k : k + 1])
        for step, inputs in enumerate(u[:, k : k + 1]):
            alone, memory = draws[k].advance(alone, inputs, memory)
            np.testing.assert_allclose(alone[0], together[step + 1][k], rtol=1e-9, atol=1e-12)


def test_a_draw_is_the_model_with_its_parameters_its_residual_and_its_rests() -> None:
    posterior, _ = _learned(hidden=0.02)
    draws = posterior.draw(np.empty((0, 0)), np.random.default_rng(0), 1, 2)
    x, u = np.array([[[0.1, 0.5]], [[0.1, 0.5]]]), np.array([[[0.3]], [[0.3]]])
    reached = draws.step(x, u)
    for k in range(2):
        of_model = MODEL.drawn(draws.z[k : k + 1]).step(x[k : k + 1], u[k : k + 1])[0, 0]
        features = draws.rest.features(x[k, 0], u[k, 0], u[k, 0])
        expected = of_model + features @ draws.weights[k] + draws.rest.rests[draws.rows[k, 0]]
        np.testing.assert_allclose(reached[k, 0], expected, rtol=1e-12)
    with pytest.raises(IndexError):
        draws[2]


def test_parameters_explain_what_they_can_and_rests_the_remainder() -> None:
    exact, _ = _learned()
    inexact, _ = _learned(hidden=0.02)
    assert exact.parameters.left < 1e-3 < inexact.parameters.left < 0.5
    assert np.abs(exact.rest.rests).max() < 0.1 * np.abs(inexact.rest.rests).max()


def test_a_residual_is_learned_only_of_states_in_which_it_predicts_left_out_executions() -> None:
    rng = np.random.default_rng(0)
    model = models.Linear(0.9 * np.eye(2), np.array([[0.1], [0.1]]))
    runs = []
    for _ in range(3):
        x, u = [rng.normal(size=2)], rng.normal(size=(50, 1))
        for inputs in u:  # the first state differs by the input, the second one by noise
            x.append(model.step(x[-1], inputs) + np.array([0.05 * inputs[0], 0.05 * rng.normal()]))
        runs.append(Trajectory(np.arange(51.0), np.array(x), u))
    rest = rest_of(model, runs)
    assert rest is not None
    assert (rest.deviations > 0).tolist() == [True, False]
    assert not rest.weights[:, 1].any()


def test_without_rests_draws_are_deterministic_functions_of_states_and_inputs() -> None:
    posterior, _ = _learned(hidden=0.02)
    drawn = posterior.draw(np.empty((0, 0)), np.random.default_rng(0), 1, 3).without_noise()
    assert isinstance(drawn, ParametricDraws)
    assert drawn.rows.shape == (3, 0)
    assert drawn.without_noise() is drawn


@pytest.mark.parametrize(("share", "answer"), [(1.25, "validated"), (0.95, "falsified")])
def test_verdicts_of_a_system_in_the_family_come_after_few_executions(share: float, answer: str) -> None:
    validation = _validation()
    axis = np.linspace(0, 1, 41)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    largest = float(validation.distances(validation.space.from_unit(grid)).max())
    campaign = Campaign(validation, seed=0)
    campaign.run(20, threshold=share * largest)
    verdict = campaign.verdict(share * largest)
    assert verdict.answer == answer
    assert campaign.executions <= 15
    learned = campaign.recorder.dynamics.learned(campaign.trials)
    if answer == "validated":
        assert isinstance(learned, ParametricDynamics)
        for name, (median, low, high) in learned.values.items():
            assert median == pytest.approx(TRUE[name], rel=0.02), name
            assert low <= median <= high
        evidence = campaign.recorder.dynamics.evidence(campaign.trials, 0.95)
        assert evidence is not None
        assert set(evidence.parameters) == set(TRUE)
        assert 0.99 * largest < evidence.bound < 1.1 * largest


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_wall_that_no_parameter_has_is_not_validated_where_few_tasks_meet_it(seed: int) -> None:
    validation = _validation(wall=1.6)
    goals = np.linspace(0, 1, 201)
    grid = np.stack(np.meshgrid(goals, np.linspace(0, 1, 5)), axis=-1).reshape(-1, 2)
    distances_there = validation.distances(validation.space.from_unit(grid))
    free = _validation().distances(validation.space.from_unit(grid)).max()
    threshold = float(free + 0.6 * (distances_there.max() - free))
    assert free < threshold < distances_there.max()
    campaign = Campaign(validation, seed=seed)
    campaign.run(20, threshold=threshold)
    assert campaign.verdict(threshold).answer != "validated"


def _late(delay: float, lag: float) -> tuple[Validation, list[tuple[np.ndarray, Trajectory]]]:
    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return _mass_on_a_rail(x, u, np.array(list(TRUE.values())))

    validation = _validation()
    validation = validation.with_parts(system=systems.Imperfect(step, delay=delay, lag=lag, vectorized=True))
    points = np.random.default_rng(0).random((3, 2))
    runs = [validation.outcome(validation.space.from_unit(point)).system_trajectory for point in points]
    return validation, list(zip(points, runs, strict=True))


@pytest.mark.parametrize(("delay", "lag"), [(1.0, 0.0), (0.0, 2.0), (2.0, 1.5)])
def test_a_delay_and_a_lag_are_found_beside_parameters(delay: float, lag: float) -> None:
    validation, executed = _late(delay, lag)
    learned = DynamicsStudy(validation).learn(executed)
    assert isinstance(learned, ParametricDynamics)
    values = {name: median for name, (median, *_) in learned.values.items()}
    expected = {name: size for name, size in (("delay", delay), ("lag", lag)) if size}
    assert {name: values[name] for name in ("delay", "lag") if name in values} == pytest.approx(expected, abs=0.05)
    point = np.array([[0.9, 0.2]])
    distance = validation.outcome(validation.space.from_unit(point[0])).distance
    assert learned.expected(point)[0] == pytest.approx(distance, rel=0.02)
    prediction = learned.predict(point[0])
    assert prediction is not None
    assert prediction.median == pytest.approx(distance, rel=0.02)
