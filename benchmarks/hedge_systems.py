"""Systems on which learned dynamics mislead a search: the hedge of ``auto`` is tuned on these (``study_hedge.py``).

What closed loops do beyond the records is extrapolated, and predicted distances may be many times too large.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import Entry, experiment, listed, path, record, simulated


def lane_change(grip: float, speed: float, seed: int) -> Experiment:
    """Return a car that changes lanes on tyres that saturate at a small slip; M is linear, from gentle driving. 3-D."""
    dt, horizon = 0.05, 60

    def derivative(x: Array, u: Array) -> Array:
        heading, side, rate = x[..., 1], x[..., 2], x[..., 3]
        front = grip * np.tanh(90.0 * (u[..., 0] - (side + 1.1 * rate) / speed) / grip)
        rear = -grip * np.tanh(80.0 * (side - 1.5 * rate) / speed / grip)
        moved = side * np.cos(heading) + speed * np.sin(heading)
        return np.stack([moved, rate, front + rear - speed * rate, (1.1 * front - 1.5 * rear) / 1.8], axis=-1)

    def change(p: Parameters) -> Task:
        place, slope = path(horizon, dt, 0.0 * p.width, p.width, p.weave, p.frequency)
        still = np.zeros_like(place)
        reference = np.stack([place, slope / speed, still, still], axis=-1)
        return Task(np.zeros(4), reference=reference, horizon=horizon, dt=dt)

    system = simulated(derivative, dt, substeps=2)
    return experiment(
        "lane-change",
        "m",
        space=TaskSpace(width=(-4, 4, "m"), weave=(0, 1, "m"), frequency=(0.1, 0.8, "Hz")),
        task=change,
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.02, -0.1, -0.05], [1, 0.02, 0.1, 0.05], [0.01], dt, seed)),
        synthesizer=controllers.LQR([1.0, 10.0, 0.01, 0.5], [10.0]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def weak_rocket(seed: int) -> Experiment:
    """Return a rocket that balances on a thrust vector that saturates; M is linear, from small tilts. 3-D."""
    dt, horizon = 0.05, 60

    def derivative(x: Array, u: Array) -> Array:
        tilt, rate, drift = x[..., 0], x[..., 1], x[..., 3]
        push = 0.35 * np.tanh(u[..., 0] / 0.35)
        return np.stack([rate, 6.0 * np.sin(tilt) - 14.0 * push, drift, 9.8 * np.sin(tilt) + 2.0 * push], axis=-1)

    system = simulated(derivative, dt)
    return experiment(
        "weak-rocket",
        "m",
        space=TaskSpace(tilt=(-0.12, 0.12, "rad"), rate=(-0.15, 0.15, "rad/s"), place=(-1.5, 1.5, "m")),
        task=lambda p: Task([p.tilt, p.rate, p.place, 0.0], goal=np.zeros(4), horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(
            record(system, [-0.03, -0.05, -1, -0.2], [0.03, 0.05, 1, 0.2], [0.05], dt, seed, steps=8)
        ),
        synthesizer=controllers.LQR([20.0, 2.0, 1.0, 1.0], [2.0]),
        distance=distances.MaximumDeviation(components=(2,)),
    )


def stiff_gripper(seed: int) -> Experiment:
    """Return a slide that a spring stops at 0.8 m, which no record shows; M is linear. 4-D."""
    dt, horizon = 0.02, 100

    def derivative(x: Array, u: Array) -> Array:
        place, speed = x[..., 0], x[..., 1]
        stop = 400.0 * np.maximum(place - 0.8, 0.0)
        return np.stack([speed, u[..., 0] - stop - 0.5 * speed - 0.4 * np.tanh(20 * speed)], axis=-1)

    def move(p: Parameters) -> Task:
        place, speed = path(horizon, dt, p.start, p.goal, p.amplitude, p.frequency)
        return Task([p.start, 0.0], reference=np.stack([place, speed], axis=-1), horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    return experiment(
        "stiff-gripper",
        "m",
        space=TaskSpace(
            start=(-0.5, 0.5, "m"), goal=(-0.8, 0.9, "m"), amplitude=(0, 0.15, "m"), frequency=(0.2, 1.5, "Hz")
        ),
        task=move,
        system=system,
        model=models.Linear.fit(record(system, [-0.5, -0.5], [0.5, 0.5], [2.0], dt, seed)),
        synthesizer=controllers.LQR([60.0, 2.0], [0.02]),
        distance=distances.MeanDeviation(components=(0,)),
    )


HEDGE = listed(
    Entry("icy-lane", "saturation", partial(lane_change, 3.0, 25.0), True),
    Entry("wet-lane", "saturation", partial(lane_change, 6.0, 25.0), True),
    Entry("slow-lane", "saturation", partial(lane_change, 2.0, 12.0), True),
    Entry("weak-rocket", "saturation", weak_rocket, True),
    Entry("stiff-gripper", "contact", stiff_gripper, True),
)
