"""The four frameworks of the paper's Example 1."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ctxval import Task, Trajectory, Validation, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.errors import ModelError
from ctxval.paper.cases import pendulum
from ctxval.paper.cases.pendulum import Pendulum
from facts import refuses
from reproduce.frameworks import _Pair, frameworks, worst_open_loop


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return frameworks(0, per_axis=41, restarts=4)


def with_distance(distance: distances.Distance) -> Validation:
    parts = pendulum.experiment(0).validation
    return Validation(
        space=parts.space,
        task=parts.task,
        system=parts.system,
        model=parts.model,
        synthesizer=parts.synthesizer,
        distance=distance,
    )


def test_the_closed_loop_profiles_are_the_distances_of_validations(result: dict[str, Any]) -> None:
    goals = np.array(result["goals"])[:, None]
    for name, distance in (("ccdt", distances.WholeTrajectory()), ("custom", distances.FinalState(norm=1))):
        np.testing.assert_allclose(result[name], with_distance(distance).distances(goals), rtol=1e-9)


def test_open_loop_distances_are_far_larger_than_closed_loop_ones_and_have_converged(result: dict[str, Any]) -> None:
    assert result["bound"] == pendulum.Settings().torque < result["closed_loop_torque"]
    for open_loop, closed_loop in (("oldt", "ccdt"), ("olcd", "custom")):
        assert result[open_loop][0] > 10 * max(result[closed_loop])
        assert len(result[open_loop]) == 4
        assert result[open_loop][-1] == pytest.approx(result[open_loop][0], rel=1e-6)


# Open-loop validation: exact where the answer is known, and never worse than what is easily found


FINAL = distances.FinalState(norm=1)
WHOLE = distances.WholeTrajectory(norm=np.inf)
STILL = models.Linear(np.eye(2), np.zeros((2, 1)))
"""A model that does nothing: its worst open loop is the largest motion of the system."""


def linear_pair(seed: int, n: int = 2, m: int = 1) -> tuple[models.Linear, models.Linear]:
    rng = np.random.default_rng(seed)

    def draw() -> models.Linear:
        A = rng.normal(size=(n, n))
        return models.Linear(A / np.abs(np.linalg.eigvals(A)).max(), rng.normal(size=(n, m)), 0.1 * rng.normal(size=n))

    return draw(), draw()


def final_gaps(step: models.Linear, x: Array, horizon: int) -> tuple[Array, Array]:
    """Return the state without input, and the effect of each input on it, shapes (n,) and (H, n, m)."""
    effects = [np.linalg.matrix_power(step.A, horizon - 1 - t) @ step.B for t in range(horizon)]
    for _ in range(horizon):
        x = step.A @ x + step.c
    return x, np.array(effects)


def worst_functional(pair: tuple[models.Linear, ...], x: Array, horizon: int, bound: Array, direction: Array) -> float:
    """Return the exact maximum of ``direction' (x_S - x_M)`` at the horizon, by the sum of absolute responses."""
    (free_s, effect_s), (free_m, effect_m) = (final_gaps(step, x, horizon) for step in pair)
    responses = np.einsum("i,tij->tj", direction, effect_s - effect_m)
    return float(direction @ (free_s - free_m) + (np.abs(responses) * bound).sum())


@pytest.mark.parametrize("seed", range(4))
def test_the_final_distance_of_linear_systems_is_the_sum_of_absolute_responses(seed: int) -> None:
    pair, x = linear_pair(seed, n=3), np.array([1.0, -2.0, 0.5])
    inputs, found = worst_open_loop(*pair, Task(x, horizon=40, dt=0.1), 2.0, FINAL, restarts=8)
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))
    expected = max(worst_functional(pair, x, 40, np.array([2.0]), sign) for sign in signs)
    assert found[0] == pytest.approx(expected, rel=1e-10)
    assert (np.abs(inputs) == 2.0).all()


def distances_of(
    system: models.Model,
    model: models.Model,
    task: Task,
    inputs: Array,
    distance: Callable[[Trajectory, Trajectory, Task], Array],
) -> Array:
    """Return the open-loop distances of inputs ``(N, H, m)``, by the public parts alone."""
    batch = Task(np.tile(task.initial_state, (len(inputs), 1)), horizon=task.horizon, dt=task.dt)

    def run(step: models.Model) -> Trajectory:
        return systems.Simulated(step).execute(lambda t, x: inputs[:, t], batch)

    return distance(run(model), run(system), batch)


@pytest.fixture(scope="module")
def swing() -> models.Model:
    return models.Function(systems.rk4(Pendulum().derivative, 0.02), vectorized=True)


def pump(swing: models.Model, restarts: int = 8, seed: int = 0, horizon: int = 150) -> tuple[Array, Array]:
    """Move the hanging pendulum as far as possible with a torque that cannot hold it level."""
    task = Task([np.pi, 0.0], horizon=horizon, dt=0.02)
    return worst_open_loop(swing, STILL, task, 1.0, FINAL, restarts=restarts, seed=seed)


def test_the_pendulum_is_pumped_as_by_dynamic_programming(swing: models.Model) -> None:
    # Dynamic programming on a grid of 720 x 1601 states, its policy executed, gives 6.0184.
    assert pump(swing)[1][0] >= 6.0183


def test_the_worst_beats_random_sequences_and_stays_within_the_bound(swing: models.Model) -> None:
    (inputs, found), rng = pump(swing, restarts=4, horizon=60), np.random.default_rng(0)
    sequences = rng.choice([-1.0, 1.0], size=(1000, 60, 1)), rng.uniform(-1, 1, size=(1000, 60, 1))
    task = Task([np.pi, 0.0], horizon=60, dt=0.02)
    assert found[0] > distances_of(swing, STILL, task, np.concatenate(sequences), FINAL).max()
    assert np.abs(inputs).max() <= 1.0


def test_the_gradient_is_that_of_finite_differences(swing: models.Model) -> None:
    rng = np.random.default_rng(0)
    pair = _Pair(swing, linear_pair(0)[0], Task([1.0, -0.5], horizon=12, dt=0.02), 1.0)
    inputs, weights = rng.normal(size=(12, 1)), rng.normal(size=(13, 2))
    moves = 1e-5 * np.eye(12)[..., None]
    up, down = ((weights * pair.gap(inputs + sign * moves)).sum(axis=(-1, -2)) for sign in (1, -1))
    np.testing.assert_allclose(pair.gradient(inputs, weights)[:, 0], (up - down) / 2e-5, rtol=1e-6, atol=1e-8)


def test_systems_that_diverge_have_no_worst_open_loop() -> None:
    explosive = models.Function(lambda x, u: 1e200 * (x + u) ** 3, vectorized=True)
    with refuses(ModelError, "M", "S"):
        worst_open_loop(explosive, STILL, Task([1.0, 1.0], horizon=5, dt=1.0), 1.0, FINAL, restarts=2)
