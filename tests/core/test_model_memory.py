"""Models with memory: each closed loop has its own, and what is learned of recorded steps knows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Validation, controllers, distances, models, systems, testing
from ctxval._util.arrays import Array
from ctxval.core.model import predicted_steps, with_memory
from ctxval.core.rollout import rollout
from ctxval.errors import ConformanceError, ShapeError
from ctxval.learning import DynamicsStudy
from facts import refuses


class Filtered:
    """A mass that a filtered input drives; without memory, the filter is at rest."""

    def __init__(self, damping: float = 0.0) -> None:
        self.damping = damping

    def start(self, x: Array) -> Array:
        return np.zeros((*x.shape[:-1], 1))

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        force = memory + 0.3 * (u - memory)
        position, rate = x[..., :1], x[..., 1:]
        return np.concatenate([position + 0.1 * rate, rate + 0.1 * (force - self.damping * rate)], axis=-1), force

    def step(self, x: Array, u: Array) -> Array:
        return self.advance(x, u, self.start(x))[0]


class InPlace(Filtered):
    """It changes its memory, and the one that it starts with."""

    kept: Any = None

    def start(self, x: Array) -> Array:
        self.kept = super().start(x) if self.kept is None or self.kept.shape[:-1] != x.shape[:-1] else self.kept
        return np.asarray(self.kept)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        x_next, memory[:] = super().advance(x, u, memory)
        return x_next, memory


def make(model: Any, system: Any = None) -> Validation:
    return Validation(
        space=TaskSpace(start=(-1.0, 1.0, "m")),
        task=lambda p: Task([p.start, 0.0], goal=[0.3, 0.0], horizon=25, dt=0.1),
        system=systems.Simulated(system or model),
        model=model,
        synthesizer=controllers.LQR([1.0, 0.3], [0.1]),
        distance=distances.MaximumDeviation(),
    )


TASK = Task([[0.2, 0.0], [-0.5, 0.1]], horizon=12, dt=0.1)


def policy(t: int, x: Array) -> Array:
    return -x[..., :1] - 0.5 * x[..., 1:] + 0.1 * t


@pytest.mark.parametrize("model", [Filtered(), InPlace()])
def test_each_run_has_a_memory_of_its_own_in_any_batch(model: Any) -> None:
    together = rollout(model, policy, TASK)
    for k in range(2):
        for _ in range(2):
            np.testing.assert_array_equal(rollout(model, policy, TASK[k]).states, together.states[k])
    without = rollout(Filtered().step, policy, TASK)
    assert np.abs(without.states - together.states).max() > 0.01


@pytest.mark.parametrize("model", [Filtered(), InPlace(), models.Refined(Filtered(), None, Filtered())])  # type: ignore[arg-type]
def test_a_model_against_itself_has_the_distance_0(model: Any) -> None:
    validation = make(model)
    assert validation.distances([[-1.0], [0.5]]).tolist() == [0.0, 0.0]
    assert validation.outcome([0.5]).distance == 0.0


def test_its_contract_is_checked() -> None:
    testing.check_model(Filtered(), states=2, inputs=1)
    mixed = Filtered()
    mixed.advance = lambda x, u, memory: (x + u.mean(axis=0), memory)  # type: ignore[method-assign]
    mixed.step = lambda x, u: x  # type: ignore[method-assign]
    with refuses(ConformanceError, 1.3, 1e-10):
        testing.check_model(mixed, states=2, inputs=1)
    wrong = Filtered()
    wrong.start = lambda x: np.zeros(3)  # type: ignore[method-assign]
    wrong.step = lambda x, u: x + 0 * u  # type: ignore[method-assign]
    with refuses(ShapeError, (3,), "model"):
        make(wrong).plan_of(None, TASK)  # type: ignore[arg-type]


@pytest.mark.slow
def test_residuals_and_draws_of_executions_know_the_memory() -> None:
    validation = make(Filtered(), Filtered(0.4))
    points = np.array([[0.1], [0.5], [0.9]])
    executed = [(point, validation.outcome(validation.space.from_unit(point)).system_trajectory) for point in points]
    recorded = with_memory(validation.model, executed[0][1])
    residuals = recorded.x_next - predicted_steps(validation.model, recorded)
    np.testing.assert_allclose(
        residuals, np.stack([0 * recorded.x[:, 1], -0.04 * recorded.x[:, 1]], axis=1), atol=1e-12
    )
    learned = DynamicsStudy(validation).learn(executed)
    assert learned is not None
    new = np.array([[0.3], [0.7]])
    for point, on_mean in learned.trajectories(new):
        truth = validation.outcome(validation.space.from_unit(point)).system_trajectory
        np.testing.assert_allclose(on_mean.states, truth.states, atol=2e-3)


def test_a_design_knows_the_memory_from_the_start() -> None:
    task = Task([0.2, 0.0], goal=[0.5, 0.0], horizon=15, dt=0.1)
    controller = controllers.ILQR([1.0, 0.1], [0.01]).design(task, Filtered())
    loop = rollout(Filtered(), controller, task)
    np.testing.assert_allclose(loop.inputs, controller.inputs, atol=1e-9)
