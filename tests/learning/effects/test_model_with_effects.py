"""Effects as parts of a model: what acts, what is recorded, and the closed loop with them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Array, Task, controllers, models, systems
from ctxval.learning import effects
from ctxval.learning.effects import Effect, Joint, ModelWithEffects

DT = 0.05
MODEL = models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])
JOINT = Joint(rate=1, position=0, share=0.5, input=0)
FORCE: dict[str, Any] = {"joint": JOINT, "probe": 0.1, "dt": DT}


def loops(repaired: ModelWithEffects, system: systems.System) -> tuple[Array, Array]:
    task = Task([0.4, 0.0], goal=[0.0, 0.0], horizon=40, dt=DT)
    controller = controllers.LQR([10.0, 1.0], [0.5]).design(task, MODEL)
    return repaired.execute(controller, task).states, system.execute(controller, task).states


def test_without_causes_a_model_is_the_same() -> None:
    nothing = ModelWithEffects(MODEL, ())
    ours, theirs = loops(nothing, systems.Simulated(MODEL))
    np.testing.assert_array_equal(ours, theirs)
    assert nothing.complete


@pytest.mark.parametrize("steps", [0.3, 1.0, 2.6])
def test_late_inputs_act_as_in_an_imperfect_system(steps: float) -> None:
    repaired = ModelWithEffects(MODEL, (effects.Delay((steps,)),))
    ours, theirs = loops(repaired, systems.Imperfect(MODEL, delay=steps))
    np.testing.assert_allclose(ours, theirs, atol=1e-12)
    assert not repaired.complete


def test_a_lag_lets_the_mean_of_an_exponential_act() -> None:
    lag = ModelWithEffects(MODEL, (effects.Lag((2.0,)),))
    acting = lag.acting(np.ones((5, 1)))[:, 0]
    ends = np.arange(6)
    exact = 1 - 2.0 * (np.exp(-ends[:-1] / 2.0) - np.exp(-ends[1:] / 2.0))
    np.testing.assert_allclose(acting, exact, rtol=1e-12)


@pytest.mark.parametrize(
    ("effect", "acts"),
    [
        (effects.InputGain((0.8,), 0), [1.6, -1.0]),
        (effects.InputGain((0.5,), None), [1.0, -0.5]),
        (effects.InputOffset((0.1,), 1), [2.0, -0.9]),
        (effects.Saturation((0.7,), 0), [0.7, -1.0]),
        (effects.DeadZone((0.25,), 1), [2.0, -0.75]),
        (effects.SwappedInputs(), [-1.0, 2.0]),
        (effects.ReversedInput((), 1), [2.0, 1.0]),
    ],
)
def test_what_acts_of_inputs(effect: Effect, acts: list[float]) -> None:
    np.testing.assert_allclose(effect.act(np.array([2.0, -1.0]), np.empty(0))[0], acts)


def test_noise_of_measurements_acts_through_the_controller() -> None:
    nothing, rng = ModelWithEffects(MODEL, ()), np.random.default_rng(0)
    task = Task([0.4, 0.0], goal=[0.0, 0.0], horizon=40, dt=DT)
    controller = controllers.LQR([10.0, 1.0], [0.5]).design(task, MODEL)
    noise = 0.01 * rng.standard_normal((41, 3, 2))
    together = nothing.execute(controller, task.starting_at(np.tile([0.4, 0.0], (3, 1))), noise)
    for k in range(3):
        alone = nothing.execute(controller, task, noise[:, k])
        np.testing.assert_allclose(together[k].states, alone.states, atol=1e-12)
        truth = alone.states - noise[:, k]
        np.testing.assert_allclose(MODEL.step(truth[1:-1], alone.inputs[1:]), truth[2:], atol=1e-12)
    np.testing.assert_array_equal(together.states[:, 0], np.tile([0.4, 0.0], (3, 1)))


def test_an_acceleration_moves_the_position_as_far_as_the_model_integrates() -> None:
    pushed = ModelWithEffects(MODEL, (effects.Bias((2.0,), Joint(rate=1, position=0, share=0.5), 0.1, DT),))
    np.testing.assert_allclose(pushed.step(np.zeros(2), np.zeros(1)), [DT**2, 2 * DT])


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (effects.Inertia((2.0,), (JOINT,), DT), [0.25 * DT**2, 0.5 * DT]),
        (effects.TimeStep((1.1,)), [0.605 * DT**2, 1.1 * DT]),
    ],
)
def test_what_an_input_of_1_does(effect: Effect, expected: list[float]) -> None:
    np.testing.assert_allclose(ModelWithEffects(MODEL, (effect,)).step(np.zeros(2), np.ones(1)), expected)


def test_the_lines_of_python_make_the_same_cause() -> None:
    for effect in (effects.Coulomb((0.4,), **FORCE), effects.Delay((1.25,)), effects.InputGain((0.5,), None)):
        assert eval(effect.python(), {"causes": effects}) == effect
