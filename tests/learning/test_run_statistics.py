"""Statistics of single runs beside what the others predict."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Trajectory, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.learning import DynamicsStudy
from ctxval.learning.run_statistics import DISTANCE, RunStatistics, influences

POINTS = np.linspace(0.05, 0.95, 6)[:, None]
THRESHOLD = 1.0


def step(x: Array, u: Array, drag: float = 0.4) -> Array:
    speed = x[..., 1]
    return np.asarray(x + 0.1 * np.stack([speed, u[..., 0] - drag * speed - 0.2 * speed * np.abs(speed)], axis=-1))


def cart(process: float = 0.0) -> Validation:
    return Validation(
        space=TaskSpace(goal=(-2.0, 2.0)),
        task=lambda p: Task(np.stack([0 * p.goal, 0 * p.goal], axis=-1), goal=[p.goal, 0.0], horizon=20, dt=0.1),
        system=systems.Imperfect(step, vectorized=True, process=[0.0, process], seed=1),
        model=models.Linear([[1.0, 0.1], [0.0, 0.97]], [[0.0], [0.1]]),
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def execute(validation: Validation, point: Array) -> tuple[Trajectory, float]:
    plan = validation.plan(validation.space.from_unit(point))
    executed = validation.execute(plan)
    return executed, validation.measure(plan, executed)


def statistics_of(validation: Validation) -> tuple[RunStatistics, list[float]]:
    runs = [execute(validation, point) for point in POINTS]
    executed = [(point, trajectory) for point, (trajectory, _) in zip(POINTS, runs, strict=True)]
    learned = DynamicsStudy(validation).learn(executed)
    assert learned is not None
    return RunStatistics.of(learned, THRESHOLD), [distance for _, distance in runs]


@pytest.fixture(scope="module")
def smooth() -> tuple[RunStatistics, list[float]]:
    return statistics_of(cart())


@pytest.fixture(scope="module")
def noisy() -> tuple[RunStatistics, list[float]]:
    return statistics_of(cart(0.02))


def test_influences_are_differences_of_single_loops(smooth: tuple[RunStatistics, list[float]]) -> None:
    """A push of the speed in every step moves the distance as a loop with that push says."""
    learned = smooth[0].learned
    found, task = influences(learned), 4
    size = 0.1 * learned.posterior.data.sizes[1]
    push, mean = np.array([0.0, size]), learned.posterior.mean
    validation = cart().with_parts(system=systems.Simulated(lambda x, u: mean.step(x, u) + push, vectorized=True))
    moved = abs(execute(validation, POINTS[task])[1] - float(learned.expected(POINTS[[task]])[0]))
    assert found[1, task] * size >= moved * (1 - 1e-6)  # the larger one of both signs
    assert found[1, task] * size < 3 * moved


@pytest.mark.slow
def test_what_moves_no_distance_is_no_change(smooth: tuple[RunStatistics, list[float]]) -> None:
    statistics, _ = smooth
    validation = cart().with_parts(
        system=systems.Simulated(lambda x, u: step(x, u, drag=0.4 * (1 + 1e-5)), vectorized=True)
    )
    trajectory, distance = execute(validation, np.array([0.3]))
    found = statistics.later(trajectory, np.array([0.3]), distance)
    assert set(found) == {
        "x0 residuals", "systematic x0 residuals", "x1 residuals", "systematic x1 residuals", DISTANCE,
    }  # fmt: skip
    assert all(each.value == pytest.approx(1, abs=0.02) for each in found.values())
    assert found["x1 residuals"].gradient is None


@pytest.mark.slow
def test_what_matters_is_many_times_what_is_negligible(smooth: tuple[RunStatistics, list[float]]) -> None:
    statistics, _ = smooth
    validation = cart().with_parts(system=systems.Simulated(lambda x, u: step(x, u, drag=0.8), vectorized=True))
    trajectory, distance = execute(validation, np.array([0.9]))
    found = statistics.later(trajectory, np.array([0.9]), distance)
    expected = statistics.learned.expected(np.array([[0.9]]))[0]
    assert abs(distance - expected) > 0.05 * THRESHOLD
    assert found[DISTANCE].value > 20
    assert found["x1 residuals"].value > 20
    without_task = statistics.later(trajectory, None, None)
    assert without_task["x1 residuals"].value == found["x1 residuals"].value
    assert DISTANCE not in without_task


@pytest.mark.slow
@pytest.mark.thorough
def test_noise_gives_statistics_near_one_and_coefficients(noisy: tuple[RunStatistics, list[float]]) -> None:
    statistics, distances_ = noisy
    assert statistics.has_noise
    certified = [statistics.certified(k, distance) for k, distance in enumerate(distances_)]
    values = [each["x1 residuals"].value for each in certified if each]
    assert len(values) == len(POINTS)
    assert 0.5 < np.mean(values) < 2.5
    slopes = certified[0]["systematic x1 residuals"] if certified[0] else None
    assert slopes is not None
    assert slopes.gradient is not None
    assert slopes.information is not None
    assert slopes.gradient.shape == (4,)  # 1, two states and an input
    np.testing.assert_allclose(slopes.information, slopes.information.T)
    assert slopes.freedom <= 4


@pytest.mark.slow
def test_an_effect_of_the_input_is_systematic(noisy: tuple[RunStatistics, list[float]]) -> None:
    """A run whose speed is pushed by a multiple of the input shows this in the part that is linear in the input."""
    statistics, _ = noisy
    validation = cart().with_parts(
        system=systems.Simulated(
            lambda x, u: step(x, u) + np.stack([0 * u[..., 0], 0.03 * u[..., 0]], -1), vectorized=True
        )
    )
    trajectory, _ = execute(validation, np.array([0.95]))
    plain = cart().with_parts(system=systems.Simulated(step, vectorized=True))
    found = [
        statistics.later(run, np.array([0.95]), None)["systematic x1 residuals"]
        for run in (trajectory, execute(plain, np.array([0.95]))[0])
    ]
    assert found[0].value > 3 * found[1].value
