"""Friction of joints, which acts while a step goes on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Array, models
from ctxval.core.trajectory import Transitions
from ctxval.learning import effects
from ctxval.learning.effects import Joint, ModelWithEffects
from ctxval.learning.effects.dry_friction import DryFriction, found_friction
from ctxval.learning.effects.flow import Flow

DT = 0.05
MODEL = models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])
JOINT = Joint(rate=1, position=0, share=0.5, input=0)
FORCE: dict[str, Any] = {"joint": JOINT, "probe": 0.1, "dt": DT}


def test_coulomb_friction_holds_at_rest_and_brakes_in_motion() -> None:
    sticking = ModelWithEffects(MODEL, (effects.Coulomb((0.4,), **FORCE),))
    x, u = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0]]), np.array([[0.3], [0.0], [0.0]])
    np.testing.assert_allclose(sticking.step(x, u)[:, 1], [0.0, 1.0 - 0.4 * DT, -1.0 + 0.4 * DT], atol=1e-12)


def test_load_dependent_friction_grows_with_what_the_gears_carry() -> None:
    friction = ModelWithEffects(MODEL, (effects.LoadFriction((0.5, 0.0), **FORCE, rates=(1,)),))
    moving = np.array([[0.0, 10.0], [0.0, 10.0]])
    lost = MODEL.step(moving, np.array([[1.0], [2.0]])) - friction.step(moving, np.array([[1.0], [2.0]]))
    np.testing.assert_allclose(lost[:, 1], [0.5 * DT, 1.0 * DT], rtol=1e-6)


def test_the_load_of_a_gear_is_that_of_its_own_motor() -> None:
    # The second motor moves the first joint, too, and a weight of 3 pulls at it.
    inverse = np.array([[2.0, -1.0], [-1.0, 3.0]])

    def step(x: Array, u: Array) -> Array:
        return x + DT * (u - np.array([3.0, 0.0])) @ inverse

    joint = Joint(rate=0, input=0)
    friction = effects.LoadFriction((0.5, 0.0), joint, 0.1, DT, rates=(0, 1))
    model = models.Function(step, vectorized=True)
    flow = Flow.of(model, np.zeros((2, 2)), np.array([[4.0, 0.0], [4.0, 9.0]]))
    loads = friction.load(flow)
    np.testing.assert_allclose(loads, [7.0, 7.0], rtol=1e-9)
    lost = friction.load(Flow.of(model, np.array([[np.nan, 0.0], [0.0, 0.0]]), flow.inputs))
    assert np.isfinite(lost).tolist() == [False, True]


def test_friction_at_rest_holds_more_than_friction_in_motion() -> None:
    friction = ModelWithEffects(MODEL, (effects.FrictionAtRest((0.2, 0.3), **FORCE, still=1e-6),))
    x, u = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]]), np.array([[0.45], [0.6], [0.0]])
    rates = friction.step(x, u)[:, 1]
    part = DT / 8  # the first part of the step, in which the joint is still at rest
    breaks = 0.1 * part + 0.4 * (DT - part)
    np.testing.assert_allclose(rates, [0.0, breaks, 1.0 - 0.2 * DT], atol=1e-12)


@pytest.mark.parametrize("dt", [0.02, 0.5])
def test_the_friction_of_verdicts_has_the_same_size(dt: float) -> None:
    model = models.Linear([[1.0, dt], [0.0, 1.0]], [[0.5 * dt**2], [dt]])
    sticking = ModelWithEffects(model, (effects.Coulomb((0.4,), JOINT, 0.1, dt),))
    rng, x, rows = np.random.default_rng(0), np.zeros((6, 2)), []
    for t in range(60):
        u = 2 * np.sin(1.8 * t * dt + np.arange(6))[:, None] + 0.5 * rng.normal(size=(6, 1)) - 0.3 * x[:, 1:]
        rows.append((x, u, sticking.step(x, u)))
        x = rows[-1][2]
    found = found_friction(model, Transitions(*map(np.concatenate, zip(*rows, strict=True))))
    assert found is not None
    np.testing.assert_allclose(found.sliding, [0.4], rtol=1e-6)


def test_friction_by_direction_brakes_each_way_by_its_own_size() -> None:
    friction = ModelWithEffects(MODEL, (effects.DirectedFriction((0.4, 0.2), **FORCE),))
    x, u = np.array([[0.0, 1.0], [0.0, -1.0], [0.0, 0.0], [0.0, 0.0]]), np.array([[0.0], [0.0], [0.39], [-0.21]])
    rates = [1.0 - 0.4 * DT, -1.0 + 0.2 * DT, 0.0, -0.01 * DT]
    np.testing.assert_allclose(friction.step(x, u)[:, 1], rates, atol=1e-12)


def test_the_friction_of_verdicts_falls_with_the_rate_by_the_same_law() -> None:
    law = ModelWithEffects(MODEL, (effects.Stribeck((0.4, 0.3, 0.2), **FORCE),))
    numbers = np.ones(1), np.zeros(1), np.full(1, 1e-3), np.zeros(1)
    rest, passed = np.full((2, 1), 0.7), np.full(1, np.inf)
    of_verdicts = DryFriction((0.4, 0.0, 0.3, 0.2), MODEL, np.array([1]), *numbers, rest, passed)
    x, u = np.array([[0.0, 1.0], [0.0, 0.3], [0.0, -0.25], [0.0, 0.0]]), np.array([[0.0], [1.0], [-0.5], [0.6]])
    np.testing.assert_allclose(
        of_verdicts.step(x, u), law.step(x, u), atol=1e-4
    )  # the sliding rate is found by iterations
