"""Effects act within a step: with a linear model, they are exact for any length of the step."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from ctxval import Array, models, systems
from ctxval.learning import effects
from ctxval.learning.effects import Joint, ModelWithEffects
from ctxval.learning.effects.flow import Flow, logarithm

STATES, INPUTS = np.array([[0.4, -0.7], [-1.0, 0.2]]), np.array([[0.5], [-0.3]])
LENGTHS = st.floats(0.02, 1.2)  # of a step; the slowest time constant is about 1


def arm(spring: float = 2.0, friction: float = 0.5, inertia: float = 1.0) -> tuple[Array, Array]:
    return np.array([[0.0, 1.0], [-spring, -friction]]) / [[1.0], [inertia]], np.array([[0.0], [1.0]]) / inertia


def sampled(A: Array, B: Array, dt: float) -> models.Linear:
    """Return the exact step of ``dx/dt = A x + B u`` for inputs that are held."""
    whole = expm(dt * np.block([[A, B], [np.zeros((1, 3))]]))
    return models.Linear(whole[:2, :2], whole[:2, 2:])


def joint(**input: int) -> Joint:
    return Joint(rate=1, position=0, share=0.5, **input)


@pytest.mark.parametrize(
    ("effect", "true"),
    [
        (lambda dt: effects.Viscous((0.7,), joint(input=0), 0.1, dt), arm(friction=1.2)),
        (lambda dt: effects.Viscous((0.7,), joint(), 0.1, dt), arm(friction=1.2)),
        (lambda dt: effects.Inertia((1.6,), (joint(),), dt), arm(inertia=1.6)),
        (lambda dt: effects.Gravity((1.5,), (joint(),), (1,), dt), arm(spring=3.0)),
    ],
)
@given(LENGTHS)
def test_a_linear_model_has_the_step_of_the_changed_equation(effect: Any, true: tuple[Array, Array], dt: float) -> None:
    repaired = ModelWithEffects(sampled(*arm(), dt), (effect(dt),))
    np.testing.assert_allclose(repaired.step(STATES, INPUTS), sampled(*true, dt).step(STATES, INPUTS), atol=2e-5)


@given(LENGTHS, st.floats(0.2, 3.5))
def test_a_part_of_a_step_and_several_steps_are_those_of_the_flow(dt: float, steps: float) -> None:
    repaired = ModelWithEffects(sampled(*arm(), dt), (effects.TimeStep((steps,)),))
    x = STATES
    np.testing.assert_allclose(repaired.step(x, INPUTS), sampled(*arm(), dt * steps).step(x, INPUTS), atol=2e-5)


@given(LENGTHS)
def test_friction_in_a_coarse_step_is_that_of_many_small_ones(dt: float) -> None:
    """The friction acts until the joint rests, which may be within the step, and then holds it."""
    exact = sampled(*arm(spring=0.0), dt)
    sticking = ModelWithEffects(exact, (effects.Coulomb((0.4,), joint(input=0), 0.1, dt),))
    small = sampled(*arm(spring=0.0), dt / 400)
    x, u = np.array([[0.0, 0.6], [0.0, 0.05], [0.0, 0.0]]), np.array([[0.0], [0.1], [0.3]])
    y = x
    for _ in range(400):
        free = small.step(y, u)
        y = small.step(y, u + np.clip(-free[:, 1:] / small.B[1], -0.4, 0.4))
    np.testing.assert_allclose(sticking.step(x, u), y, atol=4e-3 * dt)


@given(st.integers(0, 10_000), st.floats(0.01, 3.0))
def test_logarithms_are_those_of_exponentials(seed: int, size: float) -> None:
    A = np.random.default_rng(seed).normal(size=(3, 3)) * size / 3
    if np.abs(np.linalg.eigvals(A).imag).max() < 3:  # less than half a turn in a step
        np.testing.assert_allclose(logarithm(expm(A)), A, atol=1e-6)


@pytest.mark.parametrize("J", [[[0.0]], [[-1.0]], [[-0.5]], [[0.0, 0.0], [1.0, 0.0]], [[1.0, 0.1], [0.0, 1.0]]])
def test_a_flow_ends_where_the_step_ends_whatever_the_model(J: list[list[float]]) -> None:
    n = len(J)
    model, x, u = models.Linear(J, np.ones((n, 1))), np.arange(1.0, n + 1), np.array([0.3])
    np.testing.assert_allclose(Flow.of(model, x, u).end(), model.step(x, u), atol=1e-9)


@pytest.mark.parametrize("part", [0.25, 0.5, 0.8])
def test_a_smooth_model_is_interpolated_to_the_third_order(part: float) -> None:
    def pendulum(x: Array, u: Array) -> Array:
        return np.stack([x[..., 1], u[..., 0] - 4 * np.sin(x[..., 0])], axis=-1)

    def error(dt: float) -> float:
        model = models.Function(lambda x, u: systems.rk4(pendulum, dt)(x, u), vectorized=True)
        parts = ModelWithEffects(model, (effects.TimeStep((part,)),)).step(STATES, INPUTS)
        return float(np.abs(parts - systems.rk4(pendulum, dt * part)(STATES, INPUTS)).max())

    assert error(0.2) < 1e-3
    assert error(0.05) < 1.6 * error(0.1) / 8 + 1e-9  # with the third power of dt


def test_a_step_that_diverged_ends_where_the_model_ends() -> None:
    first = np.array([1e8, 1e-4])  # a product of vectors: nothing can be inverted
    model, x = models.Linear(np.outer(first, first), [[0.0], [1.0]]), np.array([0.3, 1.0])
    np.testing.assert_allclose(Flow.of(model, x, np.array([0.5])).end(), model.step(x, np.array([0.5])), rtol=1e-9)
