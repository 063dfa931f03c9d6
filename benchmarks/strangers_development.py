"""The systems of strangers on which verdicts may be developed: the regular ones, and the list of all.

Thresholds and rules may be chosen on these, and on none of ``strangers_reporting.py``. What the model of a regular one
misses is a smooth function of recorded state and input, so that a verdict is possible.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, path, record, simulated
from strangers import Stranger, drawn, gathered, row, transfer
from strangers_development_drives import DRIVES
from strangers_development_tasks import TASKS

GRAVITY = 9.81


def stalling_wing(seed: int) -> Experiment:
    """Return a glider whose lift levels off at high angles of attack; M is linear, from gentle flight. 4-D."""
    dt, horizon, speed = 0.05, 40, 14.0
    stall = drawn(seed, 241, 0.24, 0.28)

    def derivative(x: Array, u: Array) -> Array:
        slope, pitch, rate = x[..., 1], x[..., 2], x[..., 3]
        attack = pitch - slope
        lift = 45.0 * stall * np.tanh(attack / stall) / speed
        return np.stack([speed * np.sin(slope), lift, rate, 12.0 * u[..., 0] - 8.0 * attack - 3.0 * rate], axis=-1)

    def climb(p: Parameters) -> Task:
        height, rise = path(horizon, dt, 0 * p.climb, p.climb)
        reference = np.stack([height, rise / speed, rise / speed, 0 * height], axis=-1)
        return Task(row(0, p.slope, p.pitch, p.rate), reference=reference, horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    low, high = [-1, -0.04, -0.04, -0.1], [1, 0.04, 0.04, 0.1]
    return experiment(
        "stalling-wing",
        "m",
        space=TaskSpace(
            climb=(-4, 4, "m"), slope=(-0.15, 0.15, "rad"), pitch=(-0.2, 0.2, "rad"), rate=(-0.6, 0.6, "rad/s")
        ),
        task=climb,
        system=system,
        model=models.Linear.fit(record(system, low, high, [0.05], dt, seed, steps=10)),
        synthesizer=controllers.LQR([1.0, 5.0, 1.0, 0.1], [5.0]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def spinning_tracks(seed: int) -> Experiment:
    """Return a tracked robot whose tracks slip the more the harder they push and turn; M grips fully. 4-D."""
    dt, horizon = 0.1, 45
    grip = drawn(seed, 242, 1.3, 1.5)

    def derivative(slips: bool, x: Array, u: Array) -> Array:
        heading, speed, turn = x[..., 2], x[..., 3], x[..., 4]
        push = grip * np.tanh(u[..., 0] / grip) if slips else u[..., 0]
        spun = (1 - 0.15 * np.tanh(speed**2)) * u[..., 1] if slips else u[..., 1]
        return np.stack(
            [speed * np.cos(heading), speed * np.sin(heading), turn, push - 0.2 * speed, spun - 1.5 * turn], axis=-1
        )

    return experiment(
        "spinning-tracks",
        "m",
        space=TaskSpace(
            heading=(-1, 1, "rad"), speed=(-0.3, 0.8, "m/s"), goal_x=(1.5, 3, "m"), goal_y=(-1.5, 1.5, "m")
        ),
        task=lambda p: Task(
            row(0, 0, p.heading, p.speed, 0), goal=row(p.goal_x, p.goal_y, 0, 0, 0), horizon=horizon, dt=dt
        ),
        system=simulated(partial(derivative, True), dt),
        model=simulated(partial(derivative, False), dt).model,
        synthesizer=controllers.Policy(_to_goal),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def _to_goal(t: int, x: Array, task: Task) -> Array:
    gap, heading = task.goal[..., :2] - x[..., :2], x[..., 2]
    far = np.sqrt((gap**2).sum(axis=-1) + 0.04)
    along = (gap[..., 0] * np.cos(heading) + gap[..., 1] * np.sin(heading)) / far
    course = (gap[..., 1] * np.cos(heading) - gap[..., 0] * np.sin(heading)) / far
    return np.stack([3.0 * (np.tanh(far) * along - x[..., 3]), 6.0 * course - 2.0 * x[..., 4]], axis=-1)


def loaded_gantry(seed: int) -> Experiment:
    """Return a gantry in space whose hoist always carries a load, heavier the higher it is; M is learned empty. 6-D."""
    dt, horizon = 0.06, 40
    load = drawn(seed, 243, 0.18, 0.25)

    def derivative(carried: float, x: Array, u: Array) -> Array:
        velocity, height = x[..., 3:], x[..., 2]
        sag = -carried * (0.3 + 2.5 * height**3)
        pushed = u / (1 + carried) - 0.8 * velocity
        return np.concatenate([velocity, pushed + np.stack([0 * sag, 0 * sag, sag], axis=-1)], axis=-1)

    low, high = [-1, -1, 0, -0.4, -0.4, -0.4], [1, 1, 1, 0.4, 0.4, 0.4]
    empty = simulated(partial(derivative, 0.0), dt)
    return experiment(
        "loaded-gantry",
        "m",
        space=TaskSpace(start=([-1, -1, 0], [0, 1, 1], "m"), goal=([0, -1, 0], [1, 1, 1.5], "m")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=simulated(partial(derivative, load), dt),
        model=models.Linear.fit(record(empty, low, high, [1.0] * 3, dt, seed)),
        synthesizer=controllers.LQR([10.0] * 3 + [1.0] * 3, [0.2] * 3),
        distance=distances.FinalState(norm=2, components=(0, 1, 2)),
    )


def far_manipulator(seed: int) -> Experiment:
    """Return an arm on a spring, of which M is a Gaussian process of a box a third as wide as its tasks. 3-D."""
    dt, horizon = 0.06, 40

    def derivative(x: Array, u: Array) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        return np.stack([rate, u[..., 0] - 3.0 * np.sin(2 * angle) - 1.5 * angle - 0.5 * rate - 0.3 * rate**3], axis=-1)

    system = simulated(derivative, dt)
    return experiment(
        "far-manipulator",
        "rad",
        space=TaskSpace(start=(-1.5, 1.5, "rad"), rate=(-1, 1, "rad/s"), goal=(-1.5, 1.5, "rad")),
        task=lambda p: transfer(horizon, dt, row(p.start), row(p.goal), row(p.rate)),
        system=system,
        model=models.GaussianProcessModel.fit(
            record(system, [-0.5, -0.5], [0.5, 0.5], [3.0], dt, seed, rollouts=20, steps=6), points=25, seed=seed
        ),
        synthesizer=controllers.LQR([20.0, 1.0], [0.03]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def far_tower(seed: int) -> Experiment:
    """Return a tower of two storeys that stiffens far out; M is linear, from a tenth of the amplitude. 5-D."""
    dt, horizon = 0.05, 60
    hardening = drawn(seed, 244, 5.0, 6.0)

    def derivative(x: Array, u: Array) -> Array:
        first, second = x[..., 0], x[..., 1] - x[..., 0]
        low, high = (8.0 * gap + hardening * gap**3 for gap in (first, second))
        moved = [u[..., 0] - low + high - 0.5 * x[..., 2], u[..., 1] - high - 0.5 * x[..., 3]]
        return np.stack([x[..., 2], x[..., 3], *moved], axis=-1)

    system = simulated(derivative, dt)
    return experiment(
        "far-tower",
        "m",
        space=TaskSpace(start=([-1, -1], [1, 1], "m"), speed=([-1, -1], [1, 1], "m/s"), goal=(-0.5, 0.5, "m")),
        task=lambda p: Task(
            np.concatenate([p.start, p.speed], axis=-1), goal=row(p.goal, p.goal, 0, 0), horizon=horizon, dt=dt
        ),
        system=system,
        model=models.Linear.fit(record(system, [-0.1] * 4, [0.1] * 4, [0.3, 0.3], dt, seed)),
        synthesizer=controllers.LQR([5.0, 5.0, 1.0, 1.0], [0.2, 0.2]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def salt_bath(seed: int) -> Experiment:
    """Return a part in a salt bath that loses heat as hot surfaces do; M is linear, from lukewarm baths. 2-D."""
    dt, horizon = 0.3, 40
    loss = drawn(seed, 247, 0.05, 0.07)

    def derivative(x: Array, u: Array) -> Array:
        bath, part = x[..., 0], x[..., 1]
        radiated = loss * ((bath + 1.0) ** 4 - 1.0) / 8
        return np.stack([u[..., 0] - 0.4 * (bath - part) - radiated, 0.6 * (bath - part)], axis=-1)

    def warm(p: Parameters) -> Task:
        way, _ = path(horizon, dt, p.start, p.goal)
        return Task(row(p.start, p.start), reference=np.stack([way, way], axis=-1), horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    return experiment(
        "salt-bath",
        "300 K",
        space=TaskSpace(start=(0, 1.5, "300 K"), goal=(0.2, 2, "300 K")),
        task=warm,
        system=system,
        model=models.Linear.fit(record(system, [0.0, 0.0], [0.6, 0.6], [0.2], dt, seed)),
        synthesizer=controllers.LQR([1.0, 3.0], [0.5]),
        distance=distances.FinalState(norm=2),
    )


def thick_water(seed: int) -> Experiment:
    """Return a diving robot in space, whose drag by the square of the speed M has seen only slowly. 8-D."""
    dt, horizon = 0.1, 40
    drag = drawn(seed, 245, [0.5, 0.7, 0.9], [0.6, 0.8, 1.0])

    def derivative(x: Array, u: Array) -> Array:
        velocity = x[..., 3:]
        return np.concatenate([velocity, u - 0.2 * velocity - drag * velocity * np.sqrt(velocity**2 + 1e-4)], axis=-1)

    def dive(p: Parameters) -> Task:
        ahead = np.concatenate([p.speed, 0 * p.speed[..., :1]], axis=-1)
        return transfer(horizon, dt, p.start, p.goal, ahead)

    system = simulated(derivative, dt)
    low, high = [-1, -1, -1, -0.2, -0.2, -0.2], [1, 1, 1, 0.2, 0.2, 0.2]
    return experiment(
        "thick-water",
        "m",
        space=TaskSpace(
            start=([-1] * 3, [1] * 3, "m"), speed=([-0.5] * 2, [0.5] * 2, "m/s"), goal=([-1] * 3, [1] * 3, "m")
        ),
        task=dive,
        system=system,
        model=models.Linear.fit(record(system, low, high, [0.5] * 3, dt, seed)),
        synthesizer=controllers.LQR([10.0] * 3 + [1.0] * 3, [0.3] * 3),
        distance=distances.MaximumDeviation(components=(0, 1, 2)),
    )


def wagon_chain(seed: int) -> Experiment:
    """Return six wagons on couplings that stiffen, the outer ones driven; M is linear, from small moves. 4-D."""
    dt, horizon, wagons = 0.08, 50, 6
    hard = drawn(seed, 246, 25.0, 30.0)

    def derivative(x: Array, u: Array) -> Array:
        gap = np.diff(x[..., :wagons], axis=-1)
        pull = 6.0 * gap + hard * gap**3 + 1.0 * np.diff(x[..., wagons:], axis=-1)
        ends = np.zeros((*x.shape[:-1], 1))
        forces = np.concatenate([pull, ends], axis=-1) - np.concatenate([ends, pull], axis=-1)
        driven = np.concatenate([u[..., :1], *[ends] * (wagons - 2), u[..., 1:]], axis=-1)
        return np.concatenate([x[..., wagons:], forces + driven - 0.2 * x[..., wagons:]], axis=-1)

    def haul(p: Parameters) -> Task:
        spread = np.linspace(-1, 1, wagons)
        start, goal = ((a[..., None] + b[..., None] * spread) for a, b in ((p.start, p.stretch), (p.goal, 0 * p.goal)))
        return transfer(horizon, dt, start, goal, p.speed[..., None])

    system = simulated(derivative, dt)
    return experiment(
        "wagon-chain",
        "m",
        space=TaskSpace(start=(-1, 1, "m"), stretch=(-0.8, 0.8, "m"), speed=(-0.5, 0.5, "m/s"), goal=(-1, 1, "m")),
        task=haul,
        system=system,
        model=models.Linear.fit(record(system, [-0.1] * 12, [0.1] * 12, [0.3, 0.3], dt, seed)),
        synthesizer=controllers.LQR([3.0] * 6 + [1.0] * 6, [0.3, 0.3]),
        distance=distances.WholeTrajectory(components=tuple(range(wagons))),
    )


DEVELOPMENT = gathered(
    *TASKS,
    *DRIVES,
    Stranger("stalling-wing", "stall", stalling_wing),
    Stranger("spinning-tracks", "slip", spinning_tracks),
    Stranger("loaded-gantry", "payload", loaded_gantry),
    Stranger("far-manipulator", "far", far_manipulator),
    Stranger("far-tower", "far", far_tower),
    Stranger("salt-bath", "smooth", salt_bath),
    Stranger("thick-water", "smooth", thick_water),
    Stranger("wagon-chain", "smooth", wagon_chain),
)
