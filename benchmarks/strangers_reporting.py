"""The systems of strangers on which verdicts are reported: the regular ones, and the list of all.

They were written before any certificate was computed on them, and nothing may be chosen by them. They have the families
of ``strangers_development.py`` with other physics and other numbers. What the model of a regular one misses is a smooth
function of recorded state and input, so that a verdict is possible.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, path, record, simulated
from strangers import Stranger, drawn, gathered, row, transfer
from strangers_reporting_drives import DRIVES
from strangers_reporting_tasks import TASKS


def warm_bearing(seed: int) -> Experiment:
    """Return a spindle whose friction falls with its recorded temperature; M is from a cold one. 5-D."""
    dt, horizon = 0.1, 45
    thin = drawn(seed, 281, 0.7, 0.9)

    def derivative(x: Array, u: Array) -> Array:
        rate, heat = x[..., 1], x[..., 2]
        friction = 2.5 * rate * np.exp(-thin * np.tanh(heat))
        return np.stack([rate, u[..., 0] - friction, 0.5 * friction * rate - 0.1 * heat], axis=-1)

    def index(p: Parameters) -> Task:
        angle, rate = path(horizon, dt, p.start, p.goal, p.wave, p.turns)
        return Task(
            row(p.start, 0, p.heat), reference=np.stack([angle, rate, 0 * angle], axis=-1), horizon=horizon, dt=dt
        )

    system = simulated(derivative, dt)
    return experiment(
        "warm-bearing",
        "rad",
        space=TaskSpace(
            start=(-1.5, 1.5, "rad"),
            heat=(0, 1, "50 K"),
            goal=(-1.5, 1.5, "rad"),
            wave=(0, 0.4, "rad"),
            turns=(0.1, 0.4, "Hz"),
        ),
        task=index,
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.3, 0], [1, 0.3, 0.1], [1.0], dt, seed, steps=10)),
        synthesizer=controllers.LQR([10.0, 0.5, 0.0], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def mecanum_slip(seed: int) -> Experiment:
    """Return a robot on rollers, which slip more the faster it goes sideways; M has them grip. 6-D."""
    dt, horizon = 0.07, 40
    slip = drawn(seed, 282, [0.25, 0.15], [0.35, 0.25])

    def derivative(slips: float, x: Array, u: Array) -> Array:
        across, turn = x[..., 4], x[..., 5]
        worn = slips * np.tanh(across**2)
        spun = slips * np.tanh(turn**2)
        pushed = [u[..., 0] - x[..., 3], (1 - slip[0] * worn) * u[..., 1] - across - worn * across]
        return np.stack(
            [x[..., 3], across, turn, *pushed, (1 - slip[1] * spun) * u[..., 2] - 2 * turn - spun * turn], -1
        )

    low, high = [-1] * 3 + [-0.2] * 3, [1] * 3 + [0.2] * 3
    return experiment(
        "mecanum-slip",
        "m",
        space=TaskSpace(
            start=([-1, -1], [1, 1], "m"), turned=(-1, 1, "rad"), goal=([-1, -1], [1, 1], "m"), turn=(-1, 1, "rad")
        ),
        task=lambda p: transfer(
            horizon,
            dt,
            np.concatenate([p.start, row(p.turned)], axis=-1),
            np.concatenate([p.goal, row(p.turn)], axis=-1),
        ),
        system=simulated(partial(derivative, 1.0), dt),
        model=models.Linear.fit(record(simulated(partial(derivative, 0.0), dt), low, high, [1.0] * 3, dt, seed)),
        synthesizer=controllers.LQR([10.0] * 3 + [1.0] * 3, [0.3] * 3),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def tower_crane(seed: int) -> Experiment:
    """Return a slewing crane whose load adds inertia by the square of its reach; M's hook is empty. 5-D."""
    dt, horizon = 0.1, 45
    load = drawn(seed, 283, 0.35, 0.45)

    def derivative(carried: float, x: Array, u: Array) -> Array:
        reach, rate, speed = x[..., 1], x[..., 2], x[..., 3]
        inertia = 1 + carried * (reach**2 - 0.25)
        slewed = (u[..., 0] - 2 * carried * reach * speed * rate) / inertia - 0.5 * rate
        return np.stack([rate, speed, slewed, u[..., 1] - speed + carried * reach * rate**2], axis=-1)

    low, high = [-1, 0.5, -0.2, -0.2], [1, 2, 0.2, 0.2]
    empty = simulated(partial(derivative, 0.05), dt)
    return experiment(
        "tower-crane",
        "rad, m",
        space=TaskSpace(
            angle=(-1, 1, "rad"),
            reach=(0.5, 2, "m"),
            rate=(-0.5, 0.5, "rad/s"),
            goal_angle=(-1, 1, "rad"),
            goal_reach=(0.5, 2, "m"),
        ),
        task=lambda p: transfer(
            horizon, dt, row(p.angle, p.reach), row(p.goal_angle, p.goal_reach), row(p.rate, 0 * p.rate)
        ),
        system=simulated(partial(derivative, load), dt),
        model=models.Linear.fit(record(empty, low, high, [0.5, 0.5], dt, seed)),
        synthesizer=controllers.LQR([10.0, 10.0, 1.0, 1.0], [0.3, 0.3]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def far_barge(seed: int) -> Experiment:
    """Return a barge that turns hard, of which M is a Gaussian process of gentle manoeuvres. 4-D."""
    dt, horizon = 0.25, 44

    def derivative(x: Array, u: Array) -> Array:
        heading, rate = x[..., 1], x[..., 2]
        turned = 1.2 * np.tanh(u[..., 0]) - 0.6 * rate - 1.5 * rate * np.abs(rate)
        return np.stack([np.sin(heading) - 0.4 * rate, rate, turned], axis=-1)

    system = simulated(derivative, dt)
    data = record(system, [-1, -0.5, -0.25], [1, 0.5, 0.25], [0.6], dt, seed, rollouts=20, steps=8)
    return experiment(
        "far-barge",
        "m",
        space=TaskSpace(offset=(-1.5, 1.5, "m"), heading=(-1, 1, "rad"), rate=(-0.5, 0.5, "rad/s"), lane=(-1, 1, "m")),
        task=lambda p: Task(row(p.offset, p.heading, p.rate), goal=row(p.lane, 0, 0), horizon=horizon, dt=dt),
        system=system,
        model=models.GaussianProcessModel.fit(data, points=35, seed=seed),
        synthesizer=controllers.Policy(_hold_lane),
        distance=distances.MeanDeviation(components=(0,)),
    )


def _hold_lane(t: int, x: Array, task: Task) -> Array:
    course = np.clip(0.8 * (task.goal[..., 0] - x[..., 0]), -0.9, 0.9)
    return np.asarray((1.5 * (course - x[..., 1]) - 1.2 * x[..., 2])[..., None])


def far_rotor(seed: int) -> Experiment:
    """Return a rotor between magnets that pull harder the nearer it is; M is linear, from the middle. 6-D."""
    dt, horizon = 0.02, 50
    pull = drawn(seed, 284, 14.0, 16.0)

    def derivative(x: Array, u: Array) -> Array:
        place, speed = x[..., :2], x[..., 2:]
        drawn_out = pull * place / (1 - 0.3 * np.tanh(place**2)) ** 2
        whirl = 6.0 * speed[..., ::-1] * np.array([-1.0, 1.0])
        return np.concatenate([speed, u + drawn_out + whirl - 2.0 * speed], axis=-1)

    system = simulated(derivative, dt)
    return experiment(
        "far-rotor",
        "mm",
        space=TaskSpace(
            start=([-0.9] * 2, [0.9] * 2, "mm"), speed=([-4] * 2, [4] * 2, "mm/s"), goal=([-0.4] * 2, [0.4] * 2, "mm")
        ),
        task=lambda p: Task(
            np.concatenate([p.start, p.speed], axis=-1),
            goal=row(p.goal[..., 0], p.goal[..., 1], 0, 0),
            horizon=horizon,
            dt=dt,
        ),
        system=system,
        model=models.Linear.fit(record(system, [-0.2] * 4, [0.2] * 4, [5.0, 5.0], dt, seed, steps=8)),
        synthesizer=controllers.LQR([100.0, 100.0, 0.5, 0.5], [0.03, 0.03]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def ground_effect(seed: int) -> Experiment:
    """Return a drone that the ground lifts the more the lower it hovers; M is linear, from high above it. 1-D."""
    dt, horizon = 0.05, 50
    rotor = drawn(seed, 287, 0.3, 0.34)

    def derivative(x: Array, u: Array) -> Array:
        height, speed = x[..., 0], x[..., 1]
        gain = 1 / (1 - (rotor / (4 * np.sqrt(height**2 + 0.02))) ** 2)
        return np.stack([speed, (u[..., 0] + 9.81) * gain - 9.81 - 0.4 * speed], axis=-1)

    system = simulated(derivative, dt)
    return experiment(
        "ground-effect",
        "m",
        space=TaskSpace(goal=(0.15, 1.5, "m")),
        task=lambda p: transfer(horizon, dt, row(1 + 0 * p.goal), row(p.goal)),
        system=system,
        model=models.Linear.fit(record(system, [0.8, -0.3], [1.5, 0.3], [2.0], dt, seed, steps=8)),
        synthesizer=controllers.LQR([20.0, 1.0], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def long_beam(seed: int) -> Experiment:
    """Return a beam of five modes that stretching couples and stiffens; M is linear, from small bending. 5-D."""
    dt, horizon, modes = 0.05, 50, 5
    stretch = drawn(seed, 285, 5.0, 6.0)
    squares = np.array([2.0, 5.0, 10.0, 18.0, 30.0])
    shapes = np.array([[1.0, 0.8, 0.5, 0.4, 0.2], [0.3, -0.7, 0.9, -0.5, 0.4]])

    def derivative(x: Array, u: Array) -> Array:
        bent, rate = x[..., :modes], x[..., modes:]
        tension = stretch * (squares / 10 * bent**2).sum(axis=-1, keepdims=True)
        return np.concatenate([rate, u @ shapes - squares * bent - 0.4 * rate - tension * bent], axis=-1)

    def bend(p: Parameters) -> Task:
        rest = np.zeros((*p.goal.shape, modes - 3))
        start = np.concatenate([p.bent, rest, row(p.rate), np.zeros((*p.goal.shape, modes - 1))], axis=-1)
        goal = np.concatenate([row(p.goal), np.zeros((*p.goal.shape, 2 * modes - 1))], axis=-1)
        return Task(start, goal=goal, horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    return experiment(
        "long-beam",
        "cm",
        space=TaskSpace(bent=([-1, -0.7, -0.4], [1, 0.7, 0.4], "cm"), rate=(-1, 1, "cm/s"), goal=(-0.8, 0.8, "cm")),
        task=bend,
        system=system,
        model=models.Linear.fit(record(system, [-0.1] * 10, [0.1] * 10, [0.5, 0.5], dt, seed)),
        synthesizer=controllers.LQR([5.0] * 5 + [0.5] * 5, [0.1, 0.1]),
        distance=distances.WholeTrajectory(components=tuple(range(modes))),
    )


def three_vats(seed: int) -> Experiment:
    """Return three vats in a row with a reaction that heats them; M is linear, from near their usual heat. 7-D."""
    dt, horizon = 0.2, 40
    speed = drawn(seed, 286, 0.45, 0.55)

    def derivative(x: Array, u: Array) -> Array:
        strength, heat = x[..., :3], x[..., 3:]
        fed = np.concatenate([np.ones_like(strength[..., :1]), strength[..., :2]], axis=-1)
        warmed = np.concatenate([np.zeros_like(heat[..., :1]), heat[..., :2]], axis=-1)
        reacted = speed * strength * np.exp(1.2 * np.tanh(heat / 1.5))
        return np.concatenate([0.8 * (fed - strength) - reacted, 0.8 * (warmed - heat) + reacted + u], axis=-1)

    def steer(p: Parameters) -> Task:
        usual = np.broadcast_to([0.6, 0.4, 0.3], p.heat.shape)
        start = np.concatenate([p.strength[..., None] * usual, p.heat], axis=-1)
        return Task(start, goal=np.concatenate([usual, p.goal], axis=-1), horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    low, high = [0.5, 0.3, 0.2, 0.2, 0.2, 0.2], [0.7, 0.5, 0.4, 0.6, 0.6, 0.6]
    return experiment(
        "three-vats",
        "10 K",
        space=TaskSpace(strength=(0.5, 2), heat=([-1] * 3, [2] * 3, "10 K"), goal=([-0.5] * 3, [1.5] * 3, "10 K")),
        task=steer,
        system=system,
        model=models.Linear.fit(record(system, low, high, [0.2] * 3, dt, seed)),
        synthesizer=controllers.LQR([0.0] * 3 + [3.0] * 3, [0.5] * 3),
        distance=distances.WholeTrajectory(components=(3, 4, 5)),
    )


REPORTING = gathered(
    *TASKS,
    *DRIVES,
    Stranger("warm-bearing", "drift", warm_bearing),
    Stranger("mecanum-slip", "slip", mecanum_slip),
    Stranger("tower-crane", "payload", tower_crane),
    Stranger("far-barge", "far", far_barge),
    Stranger("far-rotor", "far", far_rotor),
    Stranger("ground-effect", "smooth", ground_effect),
    Stranger("long-beam", "smooth", long_beam),
    Stranger("three-vats", "smooth", three_vats),
)
