"""The systems with contacts on which the envelope was developed, beside those of the other development lists.

Of these, many tasks touch something. Those of the other lists touch it in very few tasks, so that it misleads.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, record, simulated
from strangers import drawn, norm, row, transfer


def cart_at_wall(seed: int, stiffness: float = 300.0) -> Experiment:
    """Return a cart with drag, which a quarter of the tasks bring to a wall; M is learned away from it. 3-D."""
    dt, horizon = 0.05, 40
    wall = drawn(seed, 301, 0.9, 1.0)

    def derivative(hard: float, x: Array, u: Array) -> Array:
        speed, depth = x[..., 1], np.maximum(x[..., 0] - wall, 0.0)
        pushed = hard * depth + 10.0 * (depth > 0) * speed if hard else 0.0
        return np.stack([speed, u[..., 0] - 0.5 * speed * np.abs(speed) - pushed], axis=-1)

    return experiment(
        "cart-at-wall",
        "m",
        space=TaskSpace(start=(-1, 0.5, "m"), speed=(-1, 1, "m/s"), goal=(-1, 1.3, "m")),
        task=lambda p: transfer(horizon, dt, row(p.start), row(p.goal), row(p.speed)),
        system=simulated(partial(derivative, stiffness), dt, substeps=4),
        model=models.Linear.fit(
            record(simulated(partial(derivative, 0.0), dt), [-1, -0.4], [0.5, 0.4], [1.0], dt, seed)
        ),
        synthesizer=controllers.LQR([20.0, 1.0], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def gripper_on_floor(seed: int, stiffness: float = 500.0) -> Experiment:
    """Return a gripper with drag that some tasks press on a floor; M is learned above it. 4-D."""
    dt, horizon = 0.05, 40
    floor = drawn(seed, 302, -0.85, -0.75)

    def derivative(hard: float, x: Array, u: Array) -> Array:
        velocity, depth = x[..., 2:], np.maximum(floor - x[..., 1], 0.0)
        drag = 0.6 * norm(velocity) * velocity
        pushed = hard * depth - 8.0 * (hard > 0) * (depth > 0) * velocity[..., 1]
        return np.concatenate([velocity, u - drag + np.stack([0 * pushed, pushed], axis=-1)], axis=-1)

    return experiment(
        "gripper-on-floor",
        "m",
        space=TaskSpace(start=([-1, -0.5], [0, 1], "m"), goal=([-1, -1], [1, 1], "m")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=simulated(partial(derivative, stiffness), dt, substeps=4),
        model=models.Linear.fit(
            record(
                simulated(partial(derivative, 0.0), dt), [-1, -1, -0.4, -0.4], [0, 1, 0.4, 0.4], [1.0, 1.0], dt, seed
            )
        ),
        synthesizer=controllers.LQR([20.0, 20.0, 1.0, 1.0], [0.1, 0.1]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def moored_boat(seed: int, stiffness: float = 60.0) -> Experiment:
    """Return a boat with drag whose mooring pulls beyond a length; M is learned near the buoy. 6-D."""
    dt, horizon = 0.07, 40
    length = drawn(seed, 303, 1.1, 1.2)

    def derivative(hard: float, x: Array, u: Array) -> Array:
        velocity, far = x[..., 2:], norm(x[..., :2])
        pull = hard * np.maximum(far - length, 0.0) * x[..., :2] / (far + 1e-9)
        return np.concatenate([velocity, u - 0.5 * norm(velocity) * velocity - pull], axis=-1)

    return experiment(
        "moored-boat",
        "m",
        space=TaskSpace(
            start=([-0.8] * 2, [0.8] * 2, "m"), speed=([-0.5] * 2, [0.5] * 2, "m/s"), goal=([-1] * 2, [1] * 2, "m")
        ),
        task=lambda p: transfer(horizon, dt, p.start, p.goal, p.speed),
        system=simulated(partial(derivative, stiffness), dt, substeps=2),
        model=models.Linear.fit(
            record(
                simulated(partial(derivative, 0.0), dt), [-1, -1, -0.4, -0.4], [1, 1, 0.4, 0.4], [1.0, 1.0], dt, seed
            )
        ),
        synthesizer=controllers.LQR([10.0, 10.0, 1.0, 1.0], [0.2, 0.2]),
        distance=distances.FinalState(norm=2, components=(0, 1)),
    )


CONTACTS = {"cart-at-wall": cart_at_wall, "gripper-on-floor": gripper_on_floor, "moored-boat": moored_boat}
