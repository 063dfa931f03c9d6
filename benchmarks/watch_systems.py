"""Plants that a watch looks after, and what becomes of them if what they carry is heavier.

Rules were chosen on those of ``DEVELOPMENT`` only; nothing is ever tuned on those of ``REPORTING``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import noise_development
import noise_reporting
from ctxval import Experiment, systems
from ctxval._util.arrays import Array
from ctxval.core.model import Step
from noise_systems import IMPERFECTIONS, Plant

GRAVITY = 9.81


@dataclass(frozen=True)
class Watched:
    """A plant whose payload changes.

    Attributes:
        plant: with its model, tasks and controller.
        heavier: returns the step of the system whose payload is so many times as heavy.
        what: what becomes heavier.
    """

    plant: Plant
    heavier: Callable[[float], Step]
    what: str

    def experiment(self, imperfection: str, payload: float = 1.0, seed: int = 0) -> Experiment:
        """Return the experiment of the plant with an imperfection and a payload; noise follows from the seed."""
        settings: dict[str, Any] = dict(IMPERFECTIONS[imperfection])
        for name in {"process", "measurement", "resolution"} & set(settings):
            settings[name] = settings[name] * np.array(self.plant.ranges)
        return self.plant.make(0, systems.Imperfect(self.heavier(payload), vectorized=True, seed=seed, **settings))


def _cart(payload: float) -> Step:
    def step(x: Array, u: Array) -> Array:
        speed = x[..., 1]
        force = u[..., 0] - 0.4 * speed - 0.15 * speed * np.abs(speed)
        return np.asarray(x + 0.05 * np.stack([speed, force / payload], axis=-1))

    return step


def _pendulum(payload: float) -> Step:
    def step(x: Array, u: Array) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        moment = 0.93 * u[..., 0] - 0.5 * rate - 0.6 * np.tanh(rate / 0.3)
        change = 1.1 * GRAVITY * np.sin(angle) + moment / payload
        return np.asarray(x + 0.05 * np.stack([rate, change], axis=-1))

    return step


def _crane(payload: float) -> Step:
    return systems.rk4(noise_reporting._crane(0.25, 2.0 * payload), 0.06)


def _quadrotor(payload: float) -> Step:
    return systems.rk4(noise_reporting._planar_quadrotor(1.06 * payload, 0.3), 0.05)


def _arm(payload: float) -> Step:
    light = noise_reporting._arm(0.15, 0.3)

    def derivative(x: Array, u: Array) -> Array:
        # The forces of inertia grow with the masses; torques and friction do not.
        friction = -0.3 * x[..., 2:]
        return light(x, (u + friction) / payload - friction)

    return systems.rk4(derivative, 0.04)


def _chain(payload: float) -> Step:
    light = noise_reporting._chain(6.0, 0.5)

    def derivative(x: Array, u: Array) -> Array:
        return light(x, u) / np.array([1.0, 1.0, 1.0, 1.0, 1.0, payload])

    return systems.rk4(derivative, 0.06)


def _ship(payload: float) -> Step:
    light = noise_reporting._ship(0.9, 0.12)

    def derivative(x: Array, u: Array) -> Array:
        return light(x, u) / np.array([1.0, payload, 1.0])

    return systems.rk4(derivative, 0.1)


DEVELOPMENT = {
    "cart": Watched(noise_development.PLANTS["cart"], _cart, "the cart"),
    "pendulum": Watched(noise_development.PLANTS["pendulum"], _pendulum, "the bob"),
}

REPORTING = {
    "crane": Watched(noise_reporting.PLANTS["crane"], _crane, "the hanging load"),
    "quadrotor": Watched(noise_reporting.PLANTS["quadrotor"], _quadrotor, "the quadrotor with its load"),
    "arm": Watched(noise_reporting.PLANTS["arm"], _arm, "the links"),
    "chain": Watched(noise_reporting.PLANTS["chain"], _chain, "the last cart"),
    "ship": Watched(noise_reporting.PLANTS["ship"], _ship, "the ship, which turns more slowly"),
}
