"""Inputs that act late are found in executions, and what is learned is a function of those that act."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.learning import DynamicsStudy
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.effects import (
    Backlash,
    DeadZone,
    Delay,
    Effect,
    EffectCandidate,
    Lag,
    ModelWithEffects,
    RateLimit,
    Saturation,
)
from ctxval.learning.effects.inputs import InputEffects, labelled_sizes
from ctxval.systems.actuator import Actuator
from facts import assert_names
from rig_thorough import more

H, DT = 40, 0.1


def cart_step(x: Array, u: Array) -> Array:
    position, speed = x[..., 0], x[..., 1]
    return np.stack([position + DT * speed, speed + DT * (u[..., 0] - 0.4 * speed * np.abs(speed))], axis=-1)


def cart(distance: Any = None, **imperfect: Any) -> Validation:
    return Validation(
        space=TaskSpace(goal=(-2.0, 2.0, "m"), start=(-1.0, 1.0, "m")),
        task=lambda p: Task([p.start, 0.0], goal=[p.goal, 0.0], horizon=H, dt=DT),
        system=systems.Imperfect(cart_step, vectorized=True, seed=0, **imperfect),
        model=models.Linear(np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.0], [DT]])),
        synthesizer=controllers.LQR([10.0, 1.0], [1.0]),
        distance=distance or distances.MaximumDeviation(components=(0,)),
        start_tolerance=5.0,
    )


def executions(validation: Validation, count: int) -> list[tuple[Array, Any]]:
    points = np.random.default_rng(3).random((count, validation.space.dimension))
    return [(point, validation.outcome(validation.space.from_unit(point)).system_trajectory) for point in points]


def found(validation: Validation, count: int) -> dict[str, float]:
    executed = executions(validation, count)
    study = DynamicsStudy(validation)
    with_effects = study.structures.with_inputs(study, executed)
    return {} if with_effects is None else labelled_sizes(with_effects.effects, study.input_names(1))


@given(st.floats(0, 5), st.sampled_from([0.0, 0.5, 3.0]), st.integers(1, 12))
def test_what_acts_is_what_the_simulation_of_such_actuators_applies(delay: float, lag: float, steps: int) -> None:
    commands = np.random.default_rng(steps).normal(size=(steps, 2))

    def integrator(x: Array, u: Array) -> Array:
        return x + u

    task = Task(np.zeros(2), goal=np.zeros(2), horizon=steps, dt=1.0)
    applied = systems.Imperfect(integrator, delay=delay, lag=lag, vectorized=True)
    run = applied.execute(lambda t, x: commands[t], task)
    np.testing.assert_allclose(Actuator(delay, lag).acting(commands), np.diff(run.states, axis=0), atol=1e-12)


def test_a_drawn_loop_has_the_inputs_that_act_and_m_those_that_are_commanded() -> None:
    plain, points = cart(), np.random.default_rng(0).random((3, 2))
    late = LoopPlanner(plain, InputEffects((Delay((1.5,)), Lag((2.0,)))))
    (plan,) = late.plan(points)
    (given,) = LoopPlanner(plain).plan(points)
    np.testing.assert_array_equal(plan.nominal.states, given.nominal.states)
    study = DynamicsStudy(plain, effects=tuple(map(EffectCandidate, late.effects.effects)))
    learned = study.learned_alone(executions(plain, 3))
    assert learned is not None
    (loops,) = late.run(learned.mean, [plan])
    expected = learned.mean.step(loops.states[0, :, :-1], loops.inputs[0])
    np.testing.assert_allclose(expected, loops.states[0, :, 1:], atol=1e-12)
    commanded = np.stack([plan.controller(t, loops.states[0, :, t]) for t in range(H)], axis=1)
    np.testing.assert_allclose(loops.inputs[0], late.effects.acting(commanded), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "lag"), [(1.0, 1.5), *more((1.3, 0.0), (3.0, 0.0))])
def test_delays_and_lags_are_found_from_eight_executions(delay: float, lag: float) -> None:
    sizes = found(cart(delay=delay, lag=lag), 8)
    assert sizes.get("delay [steps]") == pytest.approx(delay, abs=0.02)
    assert sizes.get("lag [steps]", 0.0) == pytest.approx(lag, abs=0.03)


@pytest.mark.slow
def test_three_executions_suffice_without_noise() -> None:
    for delay in (1.0, 2.0):
        assert found(cart(delay=delay), 3) == pytest.approx({"delay [steps]": delay}, abs=0.05)


def with_effects(*effects: Effect) -> Validation:
    class Cart:
        def step(self, x: Array, u: Array) -> Array:
            return cart_step(x, u)

    return cart().with_parts(system=ModelWithEffects(Cart(), effects, 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "sizes"),
    [
        ((Backlash((0.3,)),), {"backlash of u0": 0.3}),
        *more(
            ((DeadZone((0.4,)),), {"dead zone of u0": 0.4}),
            ((Saturation((1.5,)),), {"saturation of u0": 1.5}),
            ((RateLimit((3.0,), dt=DT),), {"rate limit of u0 [/s]": 3.0}),
            ((DeadZone((0.4,)), Delay((2.0,))), {"dead zone of u0": 0.4, "delay [steps]": 2.0}),
            ((Backlash((0.3,)), Delay((1.0,))), {"backlash of u0": 0.3, "delay [steps]": 1.0}),
        ),
    ],
)
def test_effects_of_inputs_are_found_alone_and_in_pairs(effects: tuple[Effect, ...], sizes: dict[str, float]) -> None:
    assert found(with_effects(*effects), 6) == pytest.approx(sizes, rel=0.05)


def test_none_is_found_where_inputs_act_at_once() -> None:
    assert not found(cart(), 8)
    assert not found(cart(measurement=(0.01, 0.02)), 8)


@pytest.mark.thorough
def test_none_is_found_where_a_state_is_hidden_that_is_no_actuator() -> None:
    @dataclass
    class Oscillating:
        """Something heavy swings on the cart."""

        batched: bool = False

        def execute(self, controller: Any, task: Task) -> Any:
            swing = np.zeros(2)

            def step(x: Array, u: Array) -> Array:
                nonlocal swing
                pull = 4.0 * swing[0]
                swing = swing + DT * np.array([swing[1], -9.0 * swing[0] - u[0]])
                return cart_step(x, u + pull)

            return systems.Simulated(step).execute(controller, task)

    assert not found(cart().with_parts(system=Oscillating()), 8)


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.usefixtures("few_loops")
def test_the_posterior_is_of_the_inputs_that_act_and_predicts_what_is_recorded() -> None:
    validation = cart(delay=1.3)
    executed = executions(validation, 8)
    learned = DynamicsStudy(validation).learn(executed)
    assert learned is not None
    assert "delay [steps]" in learned.acting
    assert learned.posterior.data.inputs == 1
    assert learned.left_out_error < 0.07  # a share of the error of M under the inputs that act
    point = np.array([0.9, 0.2])
    prediction = learned.predict(point)
    outcome = validation.outcome(validation.space.from_unit(point))
    assert prediction is not None
    assert prediction.median == pytest.approx(outcome.distance, rel=0.01)
    assert learned.study.extended.recorded(learned.trajectories(point[None])[0][1]).inputs.shape == (H, 1)


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.usefixtures("few_loops")
def test_a_distance_of_inputs_sees_what_is_commanded() -> None:
    def effort(model: Any, system: Any, task: Task) -> Any:
        return np.abs(model.inputs - system.inputs).max(axis=(-2, -1))

    validation = cart(distance=effort, delay=2.0)
    learned = DynamicsStudy(validation).learn(executions(validation, 8))
    assert learned is not None
    assert "delay [steps]" in learned.acting
    point = np.array([[0.8, 0.3]])
    expected = validation.outcome(validation.space.from_unit(point[0])).distance
    assert learned.expected(point)[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.usefixtures("few_loops")
def test_other_task_parameters_and_late_inputs_are_found_together() -> None:
    @dataclass(frozen=True)
    class Loaded:
        batched: bool = False

        def execute(self, controller: Any, task: Task) -> Any:
            load = float(task.goal[1])  # the goal's speed is not used by the distance
            truth = systems.Imperfect(lambda x, u: cart_step(x, u / (1 + load)), delay=2.0)
            return truth.execute(controller, task)

    plain = cart()
    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m"), load=(0.0, 0.3)),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, p.load], horizon=H, dt=DT),
        system=Loaded(),
        model=plain.model,
        synthesizer=controllers.Policy(lambda t, x, task: 2.0 * (task.goal[..., :1] - x[..., :1]) - 2.5 * x[..., 1:]),
        distance=distances.MaximumDeviation(components=(0,)),
        physical=("load",),
    )
    learned = DynamicsStudy(validation).learn(executions(validation, 12))
    assert learned is not None
    assert learned.acting["delay [steps]"] == pytest.approx(2.0, abs=0.02)
    assert learned.left_out_error < 0.03


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.usefixtures("few_loops")
def test_a_cart_that_obeys_late_is_validated_and_the_verdict_says_how_late() -> None:
    validation = cart(delay=1.3)
    rng = np.random.default_rng(0)
    largest = validation.distances(validation.space.from_unit(rng.random((500, 2)))).max()
    campaign = Campaign(validation, seed=0)
    campaign.run(20, 1.3 * largest)
    verdict = campaign.verdict(1.3 * largest)
    assert verdict.answer == "validated", verdict.reason
    assert verdict.certificate is not None
    assert verdict.certificate.upper_bound >= largest
    assert verdict.certificate.details["acting"]["delay [steps]"] == pytest.approx(1.3, abs=0.02)
    assert_names(str(verdict), 1.3)
