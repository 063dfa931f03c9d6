"""Driving towards a wall on a system that is faster than its model knows, in closed form."""

from __future__ import annotations

import numpy as np

from ctxval import Array, Parameters, Task, TaskSpace, Validation, controllers, models, systems
from ctxval.distances import UnsafeMargin
from ctxval.specs import Box, ReachAvoid

HORIZON, DT, FASTER = 10, 0.1, 0.3
FARTHEST, FASTEST = 2.0, 1.5  # wall, m, and speed, m/s

D_A = FASTER * FASTEST**2
D_B = FARTHEST - (np.sqrt(1 + 4 * FASTER * FARTHEST) - 1) / (2 * FASTER)  # the speed that just reaches the last wall

SPEC = ReachAvoid(avoid=Box("wall", low=[0.0], high=[np.inf]), components=(0,))


def step(x: Array, u: Array) -> Array:
    return np.asarray(x + DT * (u + FASTER * u**2))


def drive(p: Parameters) -> Task:
    return Task([0.0], goal=[1.0], horizon=HORIZON, dt=DT, environment={"wall": [p.wall], "speed": [p.speed]})


def constant_speed(t: int, x: Array, task: Task) -> Array:
    return np.broadcast_to(task.environment["speed"], (*x.shape[:-1], 1))


def validation(margin: float | None = None, farthest: float = FARTHEST) -> Validation:
    """Return tasks of one second with rho_M = wall - speed and rho_S = rho_M - 0.3 speed^2."""
    return Validation(
        space=TaskSpace(wall=(0.4, farthest, "m"), speed=(0.5, FASTEST, "m/s")),
        task=drive,
        system=systems.Simulated(step, vectorized=True),
        model=models.Linear([[1.0]], [[DT]]),
        synthesizer=controllers.Policy(constant_speed),
        distance=UnsafeMargin(SPEC, margin),
    )


def closed_form(points: Array) -> tuple[Array, Array]:
    """Return rho_M and rho_S at points ``(N, 2)``."""
    wall, speed = points.T
    return wall - speed, wall - speed - FASTER * speed**2
