"""What closed loops show beside the noise of measurements."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Array, Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from ctxval.learning import effects
from ctxval.learning.effects import ModelWithEffects
from ctxval.studies.causes.find import ClosedLoops, ExecutedTask

DT, NOISE = 0.05, np.array([2e-3, 1e-2])
MODEL = models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])


class OneByOne:
    """An LQR controller that takes no batch."""

    def design(self, task: Task, model: Model) -> Controller:
        controller: Any = controllers.LQR([10.0, 1.0], [0.5]).design(task, model)

        def pi(t: int, x: Array) -> Array:
            assert x.ndim == 1
            return np.asarray(controller(t, x))

        return pi


def loops(synthesizer: Any) -> tuple[ClosedLoops, ExecutedTask]:
    """Return an execution with play in its actuator and noise of its measurements."""
    validation = Validation(
        space=TaskSpace(goal=(-1.5, 1.5, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=60, dt=DT),
        system=systems.Simulated(MODEL),
        model=MODEL,
        synthesizer=synthesizer,
        distance=distances.MaximumDeviation(components=(0,)),
        start_tolerance=1.0,
    )
    plan = validation.plan(np.array([1.0]))
    noise = NOISE * np.random.default_rng(5).standard_normal((61, 2))
    executed = ModelWithEffects(MODEL, (effects.Backlash((0.3,)),)).execute(plan.controller, plan.task, noise)
    execution = ExecutedTask(plan, executed)
    return ClosedLoops(validation, [execution]), execution


def test_the_right_cause_leaves_what_noise_makes() -> None:
    made, execution = loops(controllers.LQR([10.0, 1.0], [0.5]))
    right = made.predicted(ModelWithEffects(MODEL, (effects.Backlash((0.3,)),)), execution, NOISE)
    wrong = made.predicted(ModelWithEffects(MODEL, (effects.Backlash((1.5,)),)), execution, NOISE)
    assert right.by_noise.min() > 0
    assert right.deviation < right.by_noise.mean() + 3 * right.by_noise.std()
    assert wrong.deviation > wrong.by_noise.mean() + 5 * wrong.by_noise.std()
    assert right.distance < made.distances[0]


def test_controllers_without_batches_have_the_same_loops() -> None:
    right = ModelWithEffects(MODEL, (effects.Backlash((0.3,)),))
    together, alone = (
        made.predicted(right, execution, NOISE)
        for made, execution in map(loops, (controllers.LQR([10.0, 1.0], [0.5]), OneByOne()))
    )
    assert together.deviation == pytest.approx(alone.deviation, rel=1e-9)
    np.testing.assert_allclose(together.by_noise, alone.by_noise, rtol=1e-9)


def test_without_noise_a_prediction_is_one_loop() -> None:
    made, execution = loops(controllers.LQR([10.0, 1.0], [0.5]))
    predicted = made.predicted(ModelWithEffects(MODEL, ()), execution, np.zeros(2))
    np.testing.assert_array_equal(predicted.by_noise, [0.0])
    failing = made.predicted(ModelWithEffects(MODEL, (effects.InputGain((-1e3,), 0),)), execution, np.zeros(2))
    assert failing.deviation > 1e3 * predicted.deviation
