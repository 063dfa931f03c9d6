"""Causes in coarse sampling, in what controllers see, and in angles: the sizes that campaigns name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import (
    Array,
    Campaign,
    Labels,
    Task,
    TaskSpace,
    Validation,
    controllers,
    distances,
    models,
    searches,
    systems,
)
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.core.trajectory import Trajectory
from ctxval.learning import effects
from ctxval.learning.effects.transport import SeeingLate
from ctxval.studies.causes import CauseReport, find_causes
from facts import assert_names
from rig_thorough import more


def first_order(rate: float, dt: float) -> models.Linear:
    """Return the exact step of ``dx/dt = rate (u - x)``."""
    return models.Linear([[np.exp(-rate * dt)]], [[1 - np.exp(-rate * dt)]])


def found(system: Any, model: Any, dt: float, horizon: int = 15, most: int = 1) -> CauseReport:
    n = len(model.step(np.zeros(2), np.zeros(1))) if hasattr(model, "function") else len(model.A)

    def policy(t: int, x: Array, task: Task) -> Array:
        return task.goal[..., :1] + 0.4 * np.sin(1.3 * t) - 0.3 * x[..., :1]

    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0), start=(-1.0, 1.0)),
        task=lambda p: Task([p.start, *[0.0] * (n - 1)], goal=[p.goal, *[0.0] * (n - 1)], horizon=horizon, dt=dt),
        system=system,
        model=model,
        synthesizer=controllers.Policy(policy),
        distance=distances.MaximumDeviation(components=(0,)),
        labels=Labels(("theta", "rate")[:n], ("torque",), "rad"),
    )
    campaign = Campaign(validation, search=searches.by_name("random"), seed=0).run(3)
    return find_causes(campaign, most=most)


def sizes(report: CauseReport, name: str) -> tuple[float, ...]:
    assert report.named
    return next(each.causes[-1].sizes for each in report.explained if each.causes[-1].name == name)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.1, 2.0, *more(0.5, 1.0)])
def test_half_a_step_is_named_in_any_sampling(dt: float) -> None:
    report = found(systems.Simulated(first_order(1.0, dt / 2)), first_order(1.0, dt), dt)
    assert sizes(report, "time step") == pytest.approx((0.5,), rel=1e-4)
    assert_names(report.sentence, f"{500 * dt:.4g}")
    assert sizes(report, "inertia") == pytest.approx((2.0,), rel=1e-4)  # the same to this model


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1.0, *more(0.02, 0.5)])
def test_viscous_friction_is_that_of_the_differential_equation(dt: float) -> None:
    slower = models.Linear([[np.exp(-1.5 * dt)]], [[(1 - np.exp(-1.5 * dt)) / 1.5]])
    report = found(systems.Simulated(slower), first_order(1.0, dt), dt)
    assert sizes(report, "viscous friction") == pytest.approx((0.5,), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "imperfect", "size"), [("lag", {"lag": 2.0}, 2.0), ("delay", {"delay": 1.5}, 1.5)])
def test_an_imperfect_system_has_the_sizes_that_are_named(name: str, imperfect: Any, size: float) -> None:
    model = models.Linear([[1.0, 0.1], [-0.2, 0.9]], [[0.005], [0.1]])
    report = found(systems.Imperfect(model, **imperfect), model, 0.1, 25)
    assert sizes(report, name) == pytest.approx((size,), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "close"),
    [
        (effects.RateLimit((4.0,), 0, 0.1), (1e-4,)),
        (effects.InputDrift((0.3,), 0, 0.1), (1e-4,)),
        # What is added at rest follows from the pushes that a joint withstood, and from those that moved it.
        (effects.FrictionAtRest((0.2, 0.15), effects.Joint(1, 0, 0.5, 0), 0.1, 0.1, 1e-6), (0.01, 0.3)),
    ],
)
def test_limits_of_rates_drifts_and_friction_at_rest_are_named(effect: Any, close: tuple[float, ...]) -> None:
    model = models.Linear([[1.0, 0.1], [-0.2, 0.9]], [[0.005], [0.1]])
    report = found(effects.ModelWithEffects(model, (effect,)), model, 0.1, 40)
    pairs = zip(sizes(report, effect.name), effect.sizes, close, strict=True)
    assert all(size == pytest.approx(true, rel=rel) for size, true, rel in pairs)


class InParts:
    """A first-order system in which commands act late within a step, in 50 parts of it."""

    def __init__(self, dt: float, delay: float) -> None:
        self.step, self.delay = first_order(1.0, dt / 50).step, delay

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        commands = [np.zeros(1)] * 9

        def step(x: Array, u: Array) -> Array:
            commands.append(u)
            for part in range(50):
                x = self.step(x, commands[-1 - int(np.ceil(self.delay - (part + 0.5) / 50))])
            return x

        return rollout(step, controller, task)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.5, *more(1.3)])
def test_a_delay_of_a_part_of_a_coarse_step_is_named(delay: float) -> None:
    """A first-order model does not tell whether it is held over a step: both sizes are said, the real one first."""
    report = found(InParts(0.5, delay), first_order(1.0, 0.5), 0.5, 20)
    named = {each.causes[0].held: each.causes[0].sizes for each in report.explained}  # type: ignore[attr-defined]
    assert report.causes[0].sizes == named[False] == pytest.approx((delay,), rel=0.01)
    assert named[True][0] < 0.95 * delay or delay > 1
    assert_names(report.sentence, "held")


@pytest.mark.parametrize("steps", [1, 3])
def test_old_observations_are_named_with_their_age(steps: int) -> None:
    class Late:
        def execute(self, controller: Controller, task: Task) -> Trajectory:
            return rollout(model.step, SeeingLate(controller, steps), task)

    model = first_order(1.0, 0.1)
    report = found(Late(), model, 0.1, 20)
    (cause,) = report.causes
    assert (cause.name, cause.steps) == ("observation delay", steps)  # type: ignore[attr-defined]
    assert report.after == pytest.approx(0.0, abs=1e-12)


def test_a_controller_with_memory_sees_what_it_saw_some_steps_ago() -> None:
    task, seen = Task([1.0], horizon=6, dt=0.1), SeeingLate(lambda t, x: -x, 2)
    run = rollout(lambda x, u: x + u, seen, task)
    np.testing.assert_array_equal(run.inputs[:, 0], -run.states[[0, 0, 0, 1, 2, 3], 0])


def wheel(friction: float, low: float | None, turn: float) -> models.Function:
    """Return a wheel that turns on and on; the angle is kept within a turn if it has a least value."""

    def step(x: Array, u: Array) -> Array:
        scale = turn / (2 * np.pi)
        derivative = systems.rk4(lambda x, u: np.stack([x[..., 1], 3 * u[..., 0] - friction * x[..., 1]], -1), 0.1)
        y = np.array(derivative(x / scale, u) * scale)
        y[..., 0] = y[..., 0] if low is None else low + (y[..., 0] - low) % turn
        return y

    return models.Function(step, vectorized=True)


OTHER_TURNS = ((0.0, 2 * np.pi, "0 to 2 pi"), (-180.0, 360.0, "-180 to 180"))


@pytest.mark.parametrize(("low", "turn", "ends"), [(-np.pi, 2 * np.pi, "-pi to pi"), *more(*OTHER_TURNS)])
def test_an_angle_that_the_system_keeps_within_a_turn_is_named(low: float, turn: float, ends: str) -> None:
    report = found(systems.Simulated(wheel(0.5, low, turn)), wheel(0.5, None, turn), 0.1, 30)
    assert [cause.name for cause in report.causes] == ["wrapped angle"]
    assert_names(report.sentence, ends, "2 pi" if turn < 7 else "360")
    assert report.after == pytest.approx(0.0, abs=1e-9 * turn)


@pytest.mark.slow
def test_an_angle_that_m_keeps_within_a_turn_is_named_beside_another_cause() -> None:
    report = found(systems.Simulated(wheel(0.8, None, 2 * np.pi)), wheel(0.5, -np.pi, 2 * np.pi), 0.1, 30)
    assert_names(report.sentence, "pi")
    assert sizes(report, "viscous friction") == pytest.approx((0.3 / 3,), rel=0.01) or sizes(
        report, "viscous friction"
    ) == pytest.approx((0.3,), rel=0.01)  # in units of the input, or as an acceleration
