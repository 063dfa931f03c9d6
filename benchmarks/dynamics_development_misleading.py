"""The development systems that violate an assumption of a certificate from learned dynamics, and one with noise.

Listed with the others in ``dynamics_development.py``. Each takes the mechanism that misleads as an option. Shares of
tasks in docstrings are those of 20,000 random tasks in ``dynamics_check.py``, whose distance the mechanism changes by
more than a quarter of the median distance without it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models, systems
from ctxval._util.arrays import Array
from dynamics_systems import Entry, Noisy, PartlySeen, experiment, friction, path, record, repeated, simulated


def lagging_valve(seed: int, lag: float = 0.12) -> Experiment:
    """Return a boom moved by a valve whose opening lags behind the command and is not recorded. 4-D.

    The lag changes 75 % of the tasks, and the largest distance 1.5 times.
    """
    dt, horizon = 0.05, 50

    def derivative(x: Array, u: Array) -> Array:
        rate, opening = x[..., 1], x[..., 2]
        follow = np.clip((u[..., 0] - opening) / lag, -20.0, 20.0)
        return np.stack([rate, opening - 0.8 * rate - 2.0 * np.sin(x[..., 0]), follow], axis=-1)

    def sway(p: Parameters) -> Task:
        reference = np.stack(path(horizon, dt, p.start, p.goal, p.amplitude, p.frequency), axis=-1)
        return Task([p.start, 0.0], reference=reference, horizon=horizon, dt=dt)

    system = PartlySeen(derivative, dt, hidden=1)
    return experiment(
        "lagging-valve",
        "rad",
        space=TaskSpace(
            start=(-1, 1, "rad"), goal=(-1.5, 1.5, "rad"), amplitude=(0, 0.5, "rad"), frequency=(0.1, 1.2, "Hz")
        ),
        task=sway,
        system=system,
        model=models.Linear.fit(record(system, [-0.4, -0.4], [0.4, 0.4], [3.0], dt, seed)),
        synthesizer=controllers.LQR([10.0, 0.5], [0.1]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def sticky_slide(seed: int, dry: float = 0.6, extra: float = 1.2) -> Experiment:
    """Return a slide with dry friction that is larger at rest than in motion; M is learned in motion. 3-D.

    The friction changes 96 % of the tasks, and the largest distance hardly.
    """
    dt, horizon, substeps = 0.05, 40, 4
    h = dt / substeps

    def step(x: Array, u: Array) -> Array:
        speed = x[..., 1:]
        grip = dry + extra * np.exp(-((speed[..., 0] / 0.1) ** 2))
        speed = friction(speed, u - 0.4 * speed * np.abs(speed), grip, h)
        return np.concatenate([x[..., :1] + h * speed, speed], axis=-1)

    system = systems.Simulated(repeated(step, substeps), vectorized=True)
    return experiment(
        "sticky-slide",
        "m",
        space=TaskSpace(start=(-1, 1, "m"), speed=(-1, 1, "m/s"), goal=(-1, 1, "m")),
        task=lambda p: Task([p.start, p.speed], goal=[p.goal, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [-1, 1.0], [1, 2.0], [1.0], dt, seed, steps=8)),
        synthesizer=controllers.LQR([10.0, 1.0], [0.1]),
        distance=distances.FinalState(norm=2),
    )


def gust_zone(seed: int, push: float = 6.0) -> Experiment:
    """Return a trolley that meets a gust where it is far out and fast at once. 4-D.

    The gust changes 2 % of the tasks, and d* 14 times.
    """
    dt, horizon = 0.05, 40

    def derivative(x: Array, u: Array) -> Array:
        position, speed = x[..., 0], x[..., 1]
        gust = push * ((position > 0.6) & (speed > 1.2))
        return np.stack([speed, u[..., 0] - 0.3 * speed * np.abs(speed) + gust], axis=-1)

    system = simulated(derivative, dt, substeps=2)
    return experiment(
        "gust-zone",
        "m",
        space=TaskSpace(start=(-1, 1, "m"), speed=(-1.5, 1.5, "m/s"), goal=(-1, 1.2, "m"), weight=(0.5, 1.0)),
        task=lambda p: Task([p.start, p.speed], goal=[p.goal * p.weight, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.5], [0, 0.5], [1.0], dt, seed)),
        synthesizer=controllers.LQR([10.0, 1.0], [1.0]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def balance_at_limit(seed: int, heavier: float = 1.03) -> Experiment:
    """Return an inverted pendulum with little torque; M saves nearly all tasks, S, a little heavier, fewer. 3-D.

    Distances are above 0.5 rad in 8 of 10,000 tasks, and 0.0005 rad in the median.
    """
    dt, horizon = 0.05, 50

    def derivative(weight: float, x: Array, u: Array) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        return np.stack([rate, 6.0 * weight * np.sin(angle) + u[..., 0] - 0.2 * rate], axis=-1)

    rng = np.random.default_rng([seed, 5])
    return experiment(
        "balance-at-limit",
        "rad",
        space=TaskSpace(angle=(-0.3, 0.3, "rad"), rate=(-0.54, 0.54, "rad/s"), goal=(-0.1, 0.1, "rad")),
        task=lambda p: Task([p.angle, p.rate], goal=[p.goal, 0.0], horizon=horizon, dt=dt),
        system=simulated(partial(derivative, heavier), dt),
        model=simulated(partial(derivative, rng.uniform(0.995, 1.0)), dt).model,
        synthesizer=controllers.Policy(_balance, limits=3.0),
        distance=distances.FinalState(components=(0,)),
    )


def _balance(t: int, x: Array, task: Task) -> Array:
    angle, goal = x[..., 0], task.goal[..., 0]
    return np.asarray((-6.0 * np.sin(goal) - 25.0 * (angle - goal) - 6.0 * x[..., 1])[..., None])


def weak_motor(seed: int, limit: float = 3.5) -> Experiment:
    """Return a hoist whose motor gives no more than 3.5 m/s^2, which M does not know. 4-D.

    The limit changes 8 % of the tasks, and d* 3.4 times.
    """
    dt, horizon = 0.05, 40

    def derivative(x: Array, u: Array) -> Array:
        return np.stack([x[..., 1], np.clip(u[..., 0], -limit, limit) - 0.3 * x[..., 1] * np.abs(x[..., 1])], axis=-1)

    def lift(p: Parameters) -> Task:
        reference = np.stack(path(horizon, dt, p.start, p.goal, p.amplitude), axis=-1)
        return Task([p.start, p.speed], reference=reference, horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    return experiment(
        "weak-motor",
        "m",
        space=TaskSpace(start=(-1, 1, "m"), speed=(-1, 1, "m/s"), goal=(-1.5, 1.5, "m"), amplitude=(0, 0.5, "m")),
        task=lift,
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.5], [1, 0.5], [2.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 2.0], [1.0]),
        distance=distances.MeanDeviation(components=(0,)),
    )


def gate_at_post(seed: int, stiffness: float = 900.0) -> Experiment:
    """Return a gate that a few tasks bring to a post beyond their goals. 3-D.

    The post changes 0.4 % of the tasks, and d* 2.6 times.
    """
    dt, horizon, post = 0.05, 40, 1.15

    def derivative(x: Array, u: Array) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        depth = np.maximum(angle - post, 0.0)
        return np.stack([rate, u[..., 0] - rate + 0.6 * np.cos(2 * angle) - stiffness * depth], axis=-1)

    system = simulated(derivative, dt, substeps=2)
    return experiment(
        "gate-at-post",
        "rad",
        space=TaskSpace(start=(-1, 1, "rad"), rate=(-2, 2, "rad/s"), goal=(-1.1, 1.05, "rad")),
        task=lambda p: Task([p.start, p.rate], goal=[p.goal, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [-0.6, -0.5], [0.6, 0.5], [1.0], dt, seed)),
        synthesizer=controllers.LQR([10.0, 0.5], [0.5]),
        distance=distances.WholeTrajectory(norm=2, per_step=True),
    )


OVEN_NOISE = (0.02, 0.02)


def noisy_oven(seed: int, deviation: tuple[float, ...] = OVEN_NOISE) -> Experiment:
    """Return an oven and its wall, which loses heat by radiation, with noise in every step. 2-D."""
    dt, horizon = 0.5, 30

    def derivative(x: Array, u: Array) -> Array:
        oven, wall = x[..., 0], x[..., 1]
        return np.stack([u[..., 0] - 0.3 * (oven - wall), 0.3 * (oven - wall) - 0.02 * (wall + 2) ** 2], axis=-1)

    system = Noisy(systems.rk4(derivative, dt), deviation, seed)
    return experiment(
        "noisy-oven",
        "100 K",
        space=TaskSpace(start=(0, 2, "100 K"), goal=(1, 4, "100 K")),
        task=lambda p: Task([p.start, 0.5 * p.start], goal=[p.goal, 0.7 * p.goal], horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [0.5, 0.5], [1.5, 1.0], [0.4], dt, seed)),
        synthesizer=controllers.LQR([2.0, 0.2], [1.0]),
        distance=distances.MeanDeviation(),
    )


MISLEADING = (
    Entry("lagging-valve", "hidden", lagging_valve, True, partial(lagging_valve, lag=0.02), seeds=5),
    Entry("sticky-slide", "stick-slip", sticky_slide, True, partial(sticky_slide, dry=0.0, extra=0.0)),
    Entry("gust-zone", "switch", gust_zone, True, partial(gust_zone, push=0.0)),
    Entry("balance-at-limit", "cliff", balance_at_limit, True, partial(balance_at_limit, heavier=1.0)),
    Entry("weak-motor", "saturation", weak_motor, True, partial(weak_motor, limit=np.inf)),
    Entry("gate-at-post", "contact", gate_at_post, True, partial(gate_at_post, stiffness=0.0)),
    Entry(
        "noisy-oven", "noise", noisy_oven, without=partial(noisy_oven, deviation=(0.0, 0.0)), noise=OVEN_NOISE, seeds=5
    ),
)
