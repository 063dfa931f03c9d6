"""Sizes of draws: each effect of the dictionary acts on all draws and tasks at once as on each draw alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Array, Task, controllers, models, systems
from ctxval.core.model import Model, memory_in, run_of
from ctxval.core.rollout import rollout
from ctxval.core.trajectory import Transitions
from ctxval.learning import effects, learn_posterior
from ctxval.learning.effects import EffectCandidate, ModelWithEffects
from ctxval.learning.effects.dictionary import candidates, kinds
from ctxval.learning.effects.plant import plant_of

DT, DRAWS, TASKS, STEPS = 0.05, 3, 4, 5


def arm(x: Array, u: Array) -> Array:
    """The derivative of two joints whose inertias are coupled."""
    accelerations = u @ np.array([[1.0, -0.4], [-0.4, 1.0]]) - 2.0 * np.sin(x[..., :2])
    return np.concatenate([x[..., 2:], accelerations], axis=-1)


ARM = models.Function(systems.rk4(arm, DT), vectorized=True)
LINEAR = models.Linear([[1.0, DT], [-0.1, 0.97]], [[0.5 * DT**2], [DT]])


def dictionary(model: Model, n: int, m: int) -> tuple[EffectCandidate, ...]:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(200, n)), rng.normal(size=(200, m))
    plant = plant_of(model, DT, {f"x{i}": "" for i in range(n)}, {f"u{i}": "N" for i in range(m)}, x, u)
    residuals = 0.1 * (np.asarray(model.step(x, u)) - x)
    return candidates(plant, x, u, residuals, seconds=2.0)


def drawn(candidate: EffectCandidate, rng: np.random.Generator) -> list[Any]:
    """Return sizes between first guesses and bounds."""
    start = candidate.starts[0]
    ends = [(0.7 * s + 0.3 * p.low, 0.7 * s + 0.3 * p.high) for s, p in zip(start, candidate.parameters, strict=True)]
    return [rng.uniform(*each, size=(DRAWS, 1)) for each in ends]


def loop(model: ModelWithEffects, x: Array, inputs: Array) -> Array:
    """Return the states ``(steps, ..., n)`` of a loop with given inputs ``(steps, ..., m)``."""
    memory, states = memory_in(model, x), []
    for u in inputs:
        x, memory = model.advance(x, u, memory)
        states.append(x)
    return np.stack(states)


def require_equal_draws(model: Model, chosen: tuple[Any, ...], n: int, m: int) -> None:
    rng = np.random.default_rng(1)
    together = ModelWithEffects(model, chosen, m)
    x, inputs = rng.normal(size=(DRAWS, TASKS, n)), 2 * rng.normal(size=(STEPS, DRAWS, TASKS, m))
    states, steps = loop(together, x, inputs), together.step(x, inputs[0])
    some = together[np.array([0, 2])]
    np.testing.assert_allclose(loop(some, x[[0, 2]], inputs[:, [0, 2]]), states[:, [0, 2]], rtol=1e-9, atol=1e-12)
    for k in range(DRAWS):
        sizes = [[float(np.broadcast_to(s, (DRAWS, 1))[k, 0]) for s in each.sizes] for each in chosen]
        alone = ModelWithEffects(model, tuple(e.with_sizes(s) for e, s in zip(chosen, sizes, strict=True)), m)
        np.testing.assert_allclose(states[:, k], loop(alone, x[k], inputs[:, k]), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(steps[k], alone.step(x[k], inputs[0, k]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("model", "n", "m"), [(LINEAR, 2, 1), (ARM, 4, 2)])
def test_draws_run_together_as_alone(model: Model, n: int, m: int) -> None:
    rng, seen = np.random.default_rng(2), set[str]()
    for candidate in dictionary(model, n, m):
        require_equal_draws(model, (candidate.effect.with_sizes(drawn(candidate, rng)),), n, m)
        seen.add(type(candidate.effect).__name__)
    fixed = {"ObservationDelay", "WrappedAngle", "Effect"}  # sizes that are counted
    fixed |= {"JointStop", "RunOffset"}  # nothing stops, and there is one run
    # A constant force on a driven joint is an offset of its input.
    of_mujoco = {"JointAttribute", "BodyMass", "MassCentre", "SharedAttribute"}
    assert m == 1 or seen == {kind.__name__ for kind in kinds()} - fixed - of_mujoco - {"Bias"}


def test_effects_act_together_in_draws() -> None:
    column = np.array([[0.3], [1.0], [2.4]])
    chosen = (
        effects.Delay((column,), held=False),
        effects.Lag((column,)),
        effects.Backlash((0.1 * column,), 1),
        effects.InputGain((column,), None),
        effects.Coulomb((0.2 * column,), effects.Joint(2, 0, 0.5, 0), 0.1, DT),
        effects.Bias((0.1 * column,), effects.Joint(3, 1, 0.5), 0.1, DT),
        effects.TimeStep((column,)),
        effects.SensorScale((column,), (0, 2)),
        effects.JointStop((0.2 * column, 40 * column), effects.Joint(2, 0), soft=True, dt=DT),
        effects.JointStop((-0.1 * column,), effects.Joint(3, 1), upper=False, dt=DT),
    )
    require_equal_draws(ARM, chosen, 4, 2)


def test_draws_of_attributes_of_mujoco_run_one_after_the_other() -> None:
    pytest.importorskip("mujoco")
    model = models.MuJoCo(
        """<mujoco><option timestep="0.01"/><worldbody><body name="link">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.5"/>
        </body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>""",
        dt=DT,
    )
    column, joint = np.array([[0.1], [0.2], [0.3]]), effects.Joint(1, 0, 1.0, 0, 0)
    chosen = effects.JointAttribute((column,), "frictionloss", joint), effects.Delay((5 * column,))
    require_equal_draws(model, chosen, 2, 1)
    require_equal_draws(model, (effects.BodyMass((1 + column,)), effects.Bias((0.1,), joint)), 2, 1)


@pytest.mark.parametrize(
    "chosen",
    [(effects.Delay((1.3,)),), (effects.Delay((0.6,), held=False), effects.Lag((2.0,))), (effects.Backlash((0.2,)),)],
)
def test_a_closed_loop_on_the_model_with_memory_is_its_execution(chosen: tuple[Any, ...]) -> None:
    task = Task([0.4, 0.0], goal=[0.0, 0.0], horizon=30, dt=DT)
    controller = controllers.LQR([10.0, 1.0], [0.5]).design(task, LINEAR)
    model = ModelWithEffects(LINEAR, chosen, 1)
    looped = rollout(run_of(model, np.array([0.4, 0.0])), controller, task)
    np.testing.assert_allclose(looped.states, model.execute(controller, task).states, rtol=1e-12)


def test_draws_of_effects_act_around_draws_of_the_residual() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(60, 2)), rng.normal(size=(60, 1))
    missed = np.stack([0 * x[:, 0], -0.02 * np.sin(2 * x[:, 0])], axis=-1)
    posterior = learn_posterior(LINEAR, Transitions(x, u, LINEAR.step(x, u) + missed), np.arange(60) // 20)
    assert posterior is not None
    residuals = posterior.draw(posterior.data.pairs, rng, 1)
    column = np.linspace(0.1, 0.4, len(residuals))[:, None]
    chosen = effects.Delay((3 * column,)), effects.Coulomb((column,), effects.Joint(1, 0, 0.5, 0), 0.1, DT)
    together = ModelWithEffects(residuals, chosen, 1)
    begun, inputs = rng.normal(size=(len(residuals), TASKS, 2)), rng.normal(size=(STEPS, len(residuals), TASKS, 1))
    states, k = loop(together, begun, inputs), len(residuals) // 2
    sizes = [[float(size[k, 0]) for size in each.sizes] for each in chosen]
    numbers = tuple(each.with_sizes(few) for each, few in zip(chosen, sizes, strict=True))
    alone, some = ModelWithEffects(residuals[[k]], numbers, 1), together[np.array([0, k])]
    np.testing.assert_allclose(loop(some, begun[[0, k]], inputs[:, [0, k]]), states[:, [0, k]], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(states[:, k], loop(alone, begun[k], inputs[:, k]), rtol=1e-9, atol=1e-12)
