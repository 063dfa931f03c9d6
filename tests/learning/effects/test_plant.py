"""The joints of a model, and where forces enter."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Array, models, systems
from ctxval.core.model import Model
from ctxval.learning.effects.plant import Joint, Plant, plant_of
from ctxval.learning.effects.transport import Delay, Lag

DT = 0.02


def seen(model: Model, n: int, m: int) -> Plant:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(200, n)), rng.normal(size=(200, m))
    return plant_of(model, DT, {f"x{i}": "" for i in range(n)}, {f"u{i}": "N" for i in range(m)}, x, u)


def arm(x: Array, u: Array) -> Array:
    """The derivative of two joints whose inertias are coupled."""
    accelerations = u @ np.array([[1.0, -0.4], [-0.4, 1.0]]) - 2.0 * np.sin(x[..., :2])
    return np.concatenate([x[..., 2:], accelerations], axis=-1)


def test_the_share_of_the_last_rate_tells_how_a_model_integrates() -> None:
    euler = models.Function(lambda x, u: x + DT * arm(x, u), vectorized=True)
    assert [(joint.position, joint.rate) for joint in seen(euler, 4, 2).joints] == [(0, 2), (1, 3)]
    assert [joint.share for joint in seen(euler, 4, 2).joints] == pytest.approx([0.0, 0.0], abs=1e-3)
    exact = models.Function(systems.rk4(arm, DT), vectorized=True)
    assert [joint.share for joint in seen(exact, 4, 2).joints] == pytest.approx([0.5, 0.5], abs=1e-2)


def test_an_input_may_be_the_force_on_each_joint_that_it_moves() -> None:
    plant = seen(models.Function(systems.rk4(arm, DT), vectorized=True), 4, 2)
    assert {(port.rate, port.input) for port in plant.ports} == {(2, 0), (3, 0), (2, 1), (3, 1)}


def test_a_joint_that_one_input_moves_alone_has_no_other_place() -> None:
    def derivative(x: Array, u: Array) -> Array:
        return np.concatenate([x[..., 2:], u, np.zeros_like(u)], axis=-1)

    plant = seen(models.Function(systems.rk4(derivative, DT), vectorized=True), 4, 1)
    assert {(port.rate, port.input) for port in plant.ports} == {(2, 0), (3, None)}


def test_without_positions_each_state_is_pushed() -> None:
    tanks = models.Linear([[0.9, 0.05], [0.05, 0.9]], [[0.1], [0.0]])
    assert seen(tanks, 2, 1).joints == (Joint(0), Joint(1))


def test_units_of_forces_are_those_of_inputs_or_of_accelerations() -> None:
    rng, model = np.random.default_rng(0), models.Linear([[1.0, DT], [0.0, 1.0]], [[0.0], [DT]])
    states, inputs = {"angle": "rad", "rate": "rad/s"}, {"torque": "N m"}
    plant = plant_of(model, DT, states, inputs, rng.normal(size=(50, 2)), rng.normal(size=(50, 1)))
    (port,) = plant.ports
    assert (plant.force_unit(port), plant.joint_name(port)) == ("N m", "angle")
    assert plant.force_unit(Joint(1, 0)) == "rad/s^2"


@pytest.mark.parametrize(("dt", "late", "slow"), [(0.02, "60 ms", "40 ms"), (5.0, "15 s", "10 s")])
def test_slow_plants_are_late_by_seconds(dt: float, late: str, slow: str) -> None:
    x, u = np.linspace(-1, 1, 20)[:, None], np.ones((20, 1))
    plant = plant_of(models.Linear([[0.9]], [[0.1]]), dt, {"T": "degC"}, {"heat": "W"}, x, u)
    assert f"arrive {late} late" in Delay((3.0,)).sentence(plant)
    assert Lag((2.0,)).sentence(plant).endswith(f"of {slow}")
