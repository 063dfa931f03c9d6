"""The conformance checks pass what is right and name what is wrong."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Task, Trajectory, controllers, distances, models, searches, systems, testing
from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.errors import ConformanceError
from facts import refuses
from faulty_rig import FaultyRig

MODEL = models.Linear([[1.0, 0.1], [-0.2, 0.9]], [[0.0], [0.1]], [0.01, 0.0])
TASKS = Task([np.linspace(-1, 1, 4), 0.0], goal=[0.5, 0.0], horizon=12, dt=0.1)
LQR = controllers.LQR([1.0, 1.0], [0.1])


def pendulum_step(x: Array, u: Array) -> Array:
    rate = x[..., 1] + 0.1 * (np.sin(x[..., 0]) + u[..., 0])
    return np.stack([x[..., 0] + 0.1 * rate, rate], axis=-1)


@pytest.mark.parametrize(
    "model", [MODEL, models.Function(pendulum_step, vectorized=True), models.Function(pendulum_step)]
)
def test_sound_models_pass(model: models.Model) -> None:
    testing.check_model(model, states=2, inputs=1)


def test_a_model_that_mixes_up_its_batch_is_named() -> None:
    mixed = models.Function(lambda x, u: x - x.mean(axis=0), vectorized=True)
    with refuses(ConformanceError, 1.4, 1e-10):
        testing.check_model(mixed, states=2, inputs=1)


def test_a_wrong_jacobian_is_named() -> None:
    class Wrong(models.Linear):
        def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
            return self.A.T, self.B

    with refuses(ConformanceError, 0.3, 2e-05):
        testing.check_model(Wrong(MODEL.A, MODEL.B), states=2, inputs=1)


def test_sound_systems_pass() -> None:
    controller = LQR.design(TASKS[0], MODEL)
    testing.check_system(systems.Simulated(MODEL), controller, TASKS[0])
    testing.check_system(FaultyRig(systems.Simulated(MODEL)), controller, TASKS[0])


def test_a_system_that_is_not_reset_or_ends_early_is_named() -> None:
    class Unreset:
        state = np.zeros(2)

        def execute(self, controller: controllers.AffineFeedback, task: Task) -> Trajectory:
            moved = Task(task.initial_state + self.state, horizon=task.horizon, dt=task.dt, reference=task.reference)
            done = rollout(MODEL.step, controller, moved)
            self.state = done.final_state
            return done

    controller = LQR.design(TASKS[0], MODEL)
    with refuses(ConformanceError, 0.388407):
        testing.check_system(Unreset(), controller, TASKS[0])
    with refuses(ConformanceError, "states", (12, 2)):
        testing.check_system(FaultyRig(systems.Simulated(MODEL), {0: "short"}), controller, TASKS[0])


def test_noise_beyond_the_tolerance_is_named() -> None:
    rng = np.random.default_rng(0)
    noisy = systems.Simulated(lambda x, u: MODEL.step(x, u) + rng.normal(scale=1e-3, size=x.shape))
    controller = LQR.design(TASKS[0], MODEL)
    with refuses(ConformanceError, 0.006, 1e-10):
        testing.check_system(noisy, controller, TASKS[0])
    testing.check_system(noisy, controller, TASKS[0], tolerance=0.1)


def test_batches_that_are_exact_only_to_rounding_are_named() -> None:
    class Rounded(systems.Simulated):
        exact_batches = True

        def execute(self, controller: Controller, task: Task) -> Trajectory:
            done = super().execute(controller, task)
            done.states[..., 3, :] += 1e-13 * len(task.batch_shape)
            return done

    controller = LQR.design(TASKS[0], MODEL)
    testing.check_system(systems.Simulated(MODEL), controller, TASKS[0])
    with refuses(ConformanceError, 1e-13, 0):
        testing.check_system(Rounded(MODEL), controller, TASKS[0])


def test_sound_synthesizers_pass_and_one_that_mixes_tasks_is_named() -> None:
    testing.check_synthesizer(LQR, TASKS, MODEL)
    testing.check_synthesizer(
        controllers.ILQR([1.0, 1.0], [0.1]), TASKS, models.Function(pendulum_step, vectorized=True)
    )

    class Mixed:
        batched = True

        def design(self, task: Task, model: models.Model) -> controllers.AffineFeedback:
            mean = np.broadcast_to(task.initial_state.mean(axis=0), task.initial_state.shape)
            return LQR.design(Task(task.initial_state, goal=mean, horizon=task.horizon, dt=task.dt), model)

    with refuses(ConformanceError, 0.45, 1e-08):
        testing.check_synthesizer(Mixed(), TASKS, MODEL)


class Remembering:
    """A synthesizer of controllers with memory: ``start`` and ``step`` are the functions that it is made with."""

    def __init__(self, start: Any, step: Any) -> None:
        self.start, self.step = start, step

    def design(self, task: Task, model: models.Model) -> Any:
        return dataclasses.make_dataclass("Controlled", [])() if self.start is None else self


def test_sound_controllers_with_memory_pass_and_others_are_named() -> None:
    testing.check_synthesizer(controllers.PID(1.0, 0.5, 0.2), TASKS, MODEL)
    zeros = np.zeros(1)

    def summed(t: int, x: Array, memory: Array) -> tuple[Array, Array]:
        memory = memory - x[..., :1]
        return 0.1 * memory, memory

    testing.check_synthesizer(Remembering(lambda task: zeros, summed), TASKS, MODEL)
    with refuses(ConformanceError, "controller", [0]):
        testing.check_synthesizer(Remembering(lambda task: zeros, lambda t, x, memory: zeros), TASKS, MODEL)
    with refuses(ConformanceError, "controller", "Controlled"):
        testing.check_synthesizer(Remembering(None, None), TASKS, MODEL)
    with refuses(ConformanceError, "controller", ()):
        testing.check_synthesizer(Remembering(lambda task: zeros, lambda t, x, memory: (1.0, memory)), TASKS, MODEL)
    calls: list[int] = []

    def hidden(t: int, x: Array, memory: Array) -> tuple[Array, Array]:
        calls.append(t)
        return -0.01 * len(calls) * x[..., :1], memory

    with refuses(ConformanceError, 0.046, 1e-10):
        testing.check_synthesizer(Remembering(lambda task: zeros, hidden), TASKS, MODEL)


def pair() -> tuple[Trajectory, Trajectory]:
    controller = LQR.design(TASKS, MODEL)
    return rollout(MODEL.step, controller, TASKS), rollout(pendulum_step, controller, TASKS)


@pytest.mark.parametrize(
    "distance",
    [
        distances.FinalState(1),
        distances.WholeTrajectory(2, per_step=True),
        distances.MeanDeviation(),
        distances.GoalError(2),
    ],
)
def test_sound_distances_pass(distance: distances.Distance) -> None:
    testing.check_distance(distance, *pair(), TASKS)


def test_distances_that_are_negative_or_mix_tasks_are_named() -> None:
    with refuses(ConformanceError, 0, "distance"):
        testing.check_distance(lambda a, b, task: b.final_state[..., 0] - 10, *pair(), TASKS)
    with refuses(ConformanceError, (4,), ()):
        testing.check_distance(lambda a, b, task: np.float64(1.0), *pair(), TASKS)


@pytest.mark.parametrize("name", sorted(searches.REGISTRY.built_in))
def test_every_search_conforms(name: str) -> None:
    testing.check_search(searches.by_name(name))
    testing.check_search(searches.by_name(name), dimension=1, budget=9)


def test_a_search_with_a_hidden_state_is_named() -> None:
    class Hidden(searches.SequentialSearch):
        calls = 0

        def propose(self, rng: np.random.Generator) -> Array:
            self.calls += 1
            return np.full(self.dimension, (self.calls * 0.3) % 1.0)

    with refuses(ConformanceError, "values"):
        testing.check_search(Hidden())


def test_a_search_that_repeats_failed_points_is_named() -> None:
    class Stubborn(searches.SequentialSearch):
        def propose(self, rng: np.random.Generator) -> Array:
            return np.full(self.dimension, 0.5)

    with refuses(ConformanceError, "ask"):
        testing.check_search(Stubborn())


def test_the_rig_fails_where_it_is_told_to() -> None:
    validation = make_validation()
    rig = FaultyRig(validation.system, {1: "raise"})
    plan = validation.plan([0.5])
    assert rig.execute(plan.controller, plan.task).finite
    with refuses(RuntimeError, "motor"):
        rig.execute(plan.controller, plan.task)


class _Telling(controllers.LQR):
    """LQR whose controllers tell something as ``converged``."""

    told: object = True

    def design(self, task: Task, model: object) -> controllers.AffineFeedback:
        return dataclasses.replace(super().design(task, model), converged=self.told)  # type: ignore[arg-type]


def test_convergence_is_told_by_booleans_that_are_the_same_in_a_batch() -> None:
    batch = Task([np.ones(3), 0.0], goal=[np.arange(3.0), 0.0], horizon=5, dt=0.1)
    model = models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]])
    testing.check_synthesizer(controllers.ILQR([1, 1], [1]), batch, model)
    synthesizer = _Telling([1, 1], [1])
    for wrong in ("yes", np.array([1.0]), np.array([True, False])):
        synthesizer.told = wrong
        with refuses(ConformanceError, "controller"):
            testing.check_synthesizer(synthesizer, batch, model)
