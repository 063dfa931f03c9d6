"""Robots among obstacles whose models are wrong: in which environments are they safe?

The quadrotor and the car are of the kinds that Ghosh et al. (2019, arXiv 1902.10320) simulate, with dynamics of our
own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval import Array, Parameters, Task, TaskSpace, Validation, controllers, models, systems
from ctxval.distances import UnsafeMargin
from ctxval.specs import Ball, Box, Outside, ReachAvoid

FASTER, FARTHEST, FASTEST = 0.3, 2.0, 1.5
WALL_D_A = FASTER * FASTEST**2
WALL_D_B = FARTHEST - (np.sqrt(1 + 4 * FASTER * FARTHEST) - 1) / (2 * FASTER)
GRAVITY = 9.81


def _constant_speed(t: int, x: Array, task: Task) -> Array:
    return np.broadcast_to(task.environment["speed"], (*x.shape[:-1], 1))


def wall(margin: float | None = None) -> Validation:
    """Return driving towards a wall, of which everything is known: rho_S = rho_M - 0.3 speed^2."""

    def step(x: Array, u: Array) -> Array:
        return np.asarray(x + 0.1 * (u + FASTER * u**2))

    def task(p: Parameters) -> Task:
        return Task([0.0], goal=[1.0], horizon=10, dt=0.1, environment={"wall": [p.wall], "speed": [p.speed]})

    return Validation(
        space=TaskSpace(wall=(0.4, FARTHEST, "m"), speed=(0.5, FASTEST, "m/s")),
        task=task,
        system=systems.Simulated(step, vectorized=True),
        model=models.Linear([[1.0]], [[0.1]]),
        synthesizer=controllers.Policy(_constant_speed),
        distance=UnsafeMargin(ReachAvoid(avoid=Box("wall", low=[0.0]), components=(0,)), margin),
    )


def robot(margin: float | None = None) -> Validation:
    """Return a planar robot with a drag that its linear model lacks, an obstacle anywhere and a goal box."""

    def step(x: Array, u: Array) -> Array:
        place, speed = x[..., :2], x[..., 2:]
        force = u - 0.35 * speed * np.linalg.norm(speed, axis=-1, keepdims=True) + 0.15 * np.sin(2 * place)
        return np.concatenate([place + 0.1 * speed, speed + 0.1 * force], axis=-1)

    def task(p: Parameters) -> Task:
        around = {"obstacle": [p.ox, p.oy]}
        return Task([0.0] * 4, goal=[p.gx, 0.5 * p.gx, 0.0, 0.0], horizon=40, dt=0.1, environment=around)

    A = np.eye(4) + 0.1 * np.eye(4, k=2)
    B = np.vstack([np.zeros((2, 2)), 0.1 * np.eye(2)])
    return Validation(
        space=TaskSpace(gx=(0.5, 2.0, "m"), ox=(0.2, 1.5, "m"), oy=(-1.0, 1.0, "m")),
        task=task,
        system=systems.Simulated(step, vectorized=True),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([5, 5, 0.5, 0.5], [0.2, 0.2]),
        distance=UnsafeMargin(ReachAvoid(avoid=Ball("obstacle", radius=0.2), components=(0, 1)), margin),
    )


def quadrotor(margin: float | None = None) -> Validation:
    """Return a planar quadrotor whose model is linear about hovering and has no drag; an obstacle moves."""
    dt = 0.05

    def derivative(x: Array, u: Array) -> Array:
        roll, speed = x[..., 2], x[..., 3:5]
        thrust = GRAVITY + u[..., 0]
        drag = 0.15 * speed * np.linalg.norm(speed, axis=-1, keepdims=True)
        accelerations = np.stack([-thrust * np.sin(roll), thrust * np.cos(roll) - GRAVITY], axis=-1) - drag
        return np.concatenate([x[..., 3:], accelerations, u[..., 1:]], axis=-1)

    A, B = np.eye(6) + dt * np.eye(6, k=3), np.zeros((6, 2))
    A[3, 2], B[4, 0], B[5, 1] = -dt * GRAVITY, dt, dt

    def task(p: Parameters) -> Task:
        around = {"other": [p.oy, p.oz], "flies": [p.flies, 0.0]}
        return Task([0.0] * 6, goal=[2.0, p.height, 0, 0, 0, 0], horizon=60, dt=dt, environment=around)

    spec = ReachAvoid(
        avoid=Ball("other", velocity="flies", radius=0.25),
        reach=Box([2.0, 0.0], low=[-0.3, 0.0], high=[0.3, 1.3]),
        components=(0, 1),
    )
    return Validation(
        space=TaskSpace(oy=(0.6, 1.8, "m"), oz=(-0.2, 1.2, "m"), flies=(-0.4, 0.4, "m/s"), height=(0.3, 1.0, "m")),
        task=task,
        system=systems.Simulated(systems.rk4(derivative, dt), vectorized=True),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([4, 4, 1, 1, 1, 0.1], [0.3, 0.1]),
        distance=UnsafeMargin(spec, margin),
    )


def car(margin: float | None = None) -> Validation:
    """Return a car that passes a parked one; its model is linear and has no lag of the steering."""
    dt, speed, length = 0.1, 8.0, 2.7

    def step(x: Array, u: Array) -> Array:
        place, offset, heading, steering = (x[..., i] for i in range(4))
        steering = steering + dt / 0.35 * (u[..., 0] - steering)
        turning = speed * np.tan(steering) / length * (1 - 0.08 * np.abs(np.tan(steering)) * speed)
        moved = (place + dt * speed * np.cos(heading), offset + dt * speed * np.sin(heading), heading + dt * turning)
        return np.stack([*moved, steering], axis=-1)

    A, B = np.eye(4), np.zeros((4, 1))
    A[1, 2], A[3, 3] = dt * speed, 0.0
    B[2, 0], B[3, 0] = dt * speed / length, 1.0

    class Forward:
        """The linear model, which drives on at its speed."""

        def step(self, x: Array, u: Array) -> Array:
            return np.asarray(x @ A.T + u @ B.T + np.array([dt * speed, 0, 0, 0]))

        def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
            return np.broadcast_to(A, (*x.shape[:-1], 4, 4)), np.broadcast_to(B, (*x.shape[:-1], 4, 1))

    def task(p: Parameters) -> Task:
        times = dt * np.arange(41)
        offset = np.asarray(p.lane)[..., None] * (1 / (1 + np.exp(-2.0 * (times - np.asarray(p.change)[..., None]))))
        rows = np.stack([np.broadcast_to(speed * times, offset.shape), offset, 0 * offset, 0 * offset], axis=-1)
        return Task([0.0] * 4, reference=rows, horizon=40, dt=dt, environment={"parked": [p.parked, 0.0]})

    spec = ReachAvoid(
        avoid=[Box("parked", low=[-2.5, -1.3], high=[2.5, 1.3]), Outside(Box(low=[-2.0, -2.0], high=[40.0, 4.6]))],
        components=(0, 1),
    )
    return Validation(
        space=TaskSpace(parked=(12.0, 24.0, "m"), lane=(2.0, 4.0, "m"), change=(0.8, 1.8, "s")),
        task=task,
        system=systems.Simulated(step, vectorized=True),
        model=Forward(),
        synthesizer=controllers.LQR([0.0001, 1.0, 1.0, 0.01], [2.0], limits=0.5),
        distance=UnsafeMargin(spec, margin),
    )


SYSTEMS: dict[str, Callable[[float | None], Validation]] = {
    "wall": wall,
    "robot": robot,
    "quadrotor": quadrotor,
    "car": car,
}
TITLES = {
    "wall": "drive towards a wall, in closed form",
    "robot": "planar robot with drag, obstacle anywhere",
    "quadrotor": "quadrotor, linear about hovering, obstacle that flies",
    "car": "car passing a parked one, lag of the steering",
}
