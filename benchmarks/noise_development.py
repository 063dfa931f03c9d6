"""The plants on which rules for verdicts under noise are chosen."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctxval import Experiment, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment
from noise_systems import Plant
from strangers import row, transfer

GRAVITY = 9.81


def _cart_step(x: Array, u: Array) -> Array:
    speed = x[..., 1]
    force = u[..., 0] - 0.4 * speed - 0.15 * speed * np.abs(speed)
    return np.asarray(x + 0.05 * np.stack([speed, force], axis=-1))


def _cart(seed: int, system: Any) -> Experiment:
    """A cart with drag that M does not know. 2-D."""
    del seed
    return experiment(
        "cart", "m",
        space=TaskSpace(goal=(-2, 2, "m"), start=(-1, 1, "m")),
        task=lambda p: transfer(40, 0.05, row(p.start), row(p.goal)),
        system=system,
        model=models.Linear([[1, 0.05], [0, 1 - 0.3 * 0.05]], [[0], [0.05]]),
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
        start_tolerance=5.0,
    )  # fmt: skip


def _pendulum_step(x: Array, u: Array) -> Array:
    angle, rate = x[..., 0], x[..., 1]
    moment = 1.1 * GRAVITY * np.sin(angle) + 0.93 * u[..., 0] - 0.5 * rate - 0.6 * np.tanh(rate / 0.3)
    return np.asarray(x + 0.05 * np.stack([rate, moment], axis=-1))


def _pendulum(seed: int, system: Any) -> Experiment:
    """An unstable pendulum with friction that M does not know. 2-D."""
    del seed
    return experiment(
        "pendulum", "rad",
        space=TaskSpace(goal=(-1.2, 1.2, "rad"), start=(-1, 1, "rad")),
        task=lambda p: transfer(40, 0.05, row(p.start), row(p.goal)),
        system=system,
        model=models.Linear([[1, 0.05], [0.05 * GRAVITY, 1]], [[0], [0.05]]),
        synthesizer=controllers.LQR([20.0, 2.0], [0.05]),
        distance=distances.MaximumDeviation(components=(0,)),
        start_tolerance=5.0,
    )  # fmt: skip


PLANTS = {
    plant.name: plant
    for plant in (
        Plant("cart", _cart, _cart_step, (4.0, 6.0)),
        Plant("pendulum", _pendulum, _pendulum_step, (2.5, 8.0)),
    )
}
