"""The systems on which a certificate from learned dynamics is reported: the smooth ones, and the list of all.

They were written down before any certificate was computed on them, none is a system of ``dynamics_development.py`` with
other parameters, and nothing may be chosen by them. Those drawn from a prior are in ``dynamics_drawn.py``, and those
that mislead in ``dynamics_misleading.py``.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_drawn import DRAWN
from dynamics_misleading import MISLEADING
from dynamics_systems import Entry, experiment, listed, path, record, simulated

GRAVITY = 9.81

# Smooth


def quadrotor(seed: int) -> Experiment:
    """Return a quadrotor in a vertical plane with drag, which nominal physics do not know. 12-D, M without data."""
    dt, horizon = 0.05, 60
    nominal = np.random.default_rng([seed, 11]).uniform(0.96, 1.04, 2)

    def derivative(lift: float, torque: float, drag: float, x: Array, u: Array) -> Array:
        tilt, speed = x[..., 2], x[..., 3:5]
        slowed = -drag * speed * np.sqrt((speed**2).sum(axis=-1, keepdims=True) + 1e-4)
        thrust = lift * (GRAVITY + u[..., 0])
        across, up = -thrust * np.sin(tilt) + slowed[..., 0], thrust * np.cos(tilt) - GRAVITY + slowed[..., 1]
        turned = torque * u[..., 1] - 0.5 * drag * x[..., 5]
        return np.stack([speed[..., 0], speed[..., 1], x[..., 5], across, up, turned], axis=-1)

    def fly(p: Parameters) -> Task:
        ways = [
            path(horizon, dt, p.start[..., i], p.goal[..., i], p.amplitude[..., i], p.frequency[..., i])
            for i in range(2)
        ]
        still = np.zeros_like(ways[0][0])
        reference = np.stack([ways[0][0], ways[1][0], still, ways[0][1], ways[1][1], still], axis=-1)
        start = [*np.moveaxis(p.start, -1, 0), p.tilt, *np.moveaxis(p.speed, -1, 0), p.rate]
        return Task(start, reference=reference, horizon=horizon, dt=dt)

    return experiment(
        "quadrotor",
        "m",
        space=TaskSpace(
            start=([-1, -1], [1, 1], "m"),
            speed=([-1, -1], [1, 1], "m/s"),
            tilt=(-0.4, 0.4, "rad"),
            rate=(-1, 1, "rad/s"),
            goal=([-2, -1], [2, 1], "m"),
            amplitude=([0, 0], [0.4, 0.3], "m"),
            frequency=([0.05, 0.05], [0.3, 0.4], "Hz"),
        ),
        task=fly,
        system=simulated(partial(derivative, 1.0, 1.0, 0.25), dt),
        model=simulated(partial(derivative, *nominal, 0.0), dt).model,  # type: ignore[call-arg]
        synthesizer=controllers.Policy(_fly),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def _fly(t: int, x: Array, task: Task) -> Array:
    gap = task.reference[..., t, :] - x
    across, up = 4.0 * gap[..., 0] + 3.0 * gap[..., 3], 6.0 * gap[..., 1] + 4.0 * gap[..., 4]
    tilt = -0.6 * np.tanh(across / GRAVITY / 0.6)
    thrust = (GRAVITY + up) / np.maximum(np.cos(x[..., 2]), 0.5) - GRAVITY
    return np.stack([thrust, 40.0 * (tilt - x[..., 2]) - 10.0 * x[..., 5]], axis=-1)


def ball_on_beam(seed: int) -> Experiment:
    """Return a ball that rolls on a beam, led to a swinging reference; M is linear, from small tilts. 5-D."""
    dt, horizon = 0.05, 60

    def derivative(x: Array, u: Array) -> Array:
        place, tilt, rate = x[..., 0], x[..., 2], x[..., 3]
        rolled = (place * rate**2 - GRAVITY * np.sin(tilt)) / 1.4
        return np.stack([x[..., 1], rolled, rate, u[..., 0] - 3.0 * place * np.cos(tilt) - rate], axis=-1)

    def roll(p: Parameters) -> Task:
        place, speed = path(horizon, dt, p.place, p.goal, p.amplitude, p.frequency)
        reference = np.stack([place, speed, np.zeros_like(place), np.zeros_like(place)], axis=-1)
        return Task([p.place, p.speed, 0.0, 0.0], reference=reference, horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    return experiment(
        "ball-on-beam",
        "m",
        space=TaskSpace(
            place=(-0.5, 0.5, "m"),
            speed=(-0.6, 0.6, "m/s"),
            goal=(-0.5, 0.5, "m"),
            amplitude=(0, 0.2, "m"),
            frequency=(0.05, 0.3, "Hz"),
        ),
        task=roll,
        system=system,
        model=models.Linear.fit(record(system, [-0.2, -0.2, -0.1, -0.1], [0.2, 0.2, 0.1, 0.1], [0.5], dt, seed)),
        synthesizer=controllers.LQR([20.0, 2.0, 0.1, 0.1], [0.01]),
        distance=distances.MeanDeviation(components=(0,)),
    )


def reactor(seed: int) -> Experiment:
    """Return an exothermic stirred tank (Uppal et al. 1974), cooled by nominal chemistry. 3-D, M without data."""
    dt, horizon = 0.1, 40
    nominal = tuple(np.random.default_rng([seed, 13]).uniform([0.9, 0.9], [1.1, 1.1]))

    def derivative(rate: float, heat: float, x: Array, u: Array) -> Array:
        warmth = x[..., 1]
        reacted = 0.072 * rate * (1 - x[..., 0]) * np.exp(warmth / (1 + np.clip(warmth, -5, 20) / 20))
        return np.stack(
            [reacted - x[..., 0], 8.0 * heat * reacted - warmth + 0.6 * (u[..., 0] - warmth)],
            axis=-1,
        )

    def hold(t: int, x: Array, task: Task) -> Array:
        drift = derivative(*nominal, x, np.zeros((*x.shape[:-1], 1)))[..., 1]  # type: ignore[call-arg]
        return np.asarray(((3.0 * (task.goal[..., 1] - x[..., 1]) - drift) / 0.6)[..., None])

    return experiment(
        "reactor",
        "conversion, scaled temperature",
        space=TaskSpace(conversion=(0.05, 0.6), temperature=(0, 3), goal=(0.5, 3.5)),
        task=lambda p: Task([p.conversion, p.temperature], goal=[0.5, p.goal], horizon=horizon, dt=dt),
        system=simulated(partial(derivative, 1.0, 1.0), dt),
        model=simulated(partial(derivative, *nominal), dt).model,
        synthesizer=controllers.Policy(hold, limits=6.0),
        distance=distances.WholeTrajectory(),
    )


def loaded_arm(seed: int) -> Experiment:
    """Return an arm of two links whose payload computed torques do not know. 8-D, M without data."""
    dt, horizon = 0.03, 50
    payload = float(np.random.default_rng([seed, 17]).uniform(0.0, 0.1))

    def moments(load: float, q: Array, w: Array) -> tuple[Array, Array, Array, Array]:
        cosine, sine = np.cos(q[..., 1]), np.sin(q[..., 1])
        own, coupled = 0.33 + load, 0.5 + load
        first, mixed = 1.33 + load + own + 2 * coupled * cosine, own + coupled * cosine
        lower = (0.5 + load) * GRAVITY * np.cos(q[..., 0] + q[..., 1])
        bias = np.stack(
            [
                -coupled * sine * (2 * w[..., 0] * w[..., 1] + w[..., 1] ** 2) + lower
                + (1.5 + load) * GRAVITY * np.cos(q[..., 0]),
                coupled * sine * w[..., 0] ** 2 + lower,
            ],
            axis=-1,
        )  # fmt: skip
        return first, mixed, own + 0 * first, bias

    def derivative(load: float, x: Array, u: Array) -> Array:
        w = x[..., 2:]
        first, mixed, own, bias = moments(load, x[..., :2], w)
        push = u - bias - 0.5 * w
        determinant = first * own - mixed**2
        turned = np.stack([own * push[..., 0] - mixed * push[..., 1], first * push[..., 1] - mixed * push[..., 0]], -1)
        return np.concatenate([w, turned / determinant[..., None]], axis=-1)

    def torques(t: int, x: Array, task: Task) -> Array:
        gap = task.reference[..., t, :] - x
        a = 25.0 * gap[..., :2] + 10.0 * gap[..., 2:]
        first, mixed, own, bias = moments(payload, x[..., :2], x[..., 2:])
        return bias + np.stack([first * a[..., 0] + mixed * a[..., 1], mixed * a[..., 0] + own * a[..., 1]], axis=-1)

    def reach(p: Parameters) -> Task:
        wave = (p.amplitude, p.frequency)
        ways = [path(horizon, dt, p.start[..., i], p.goal[..., i], *(wave if i else ())) for i in range(2)]
        reference = np.stack([ways[0][0], ways[1][0], ways[0][1], ways[1][1]], axis=-1)
        return Task(np.concatenate([p.start, p.rate], axis=-1), reference=reference, horizon=horizon, dt=dt)

    return experiment(
        "loaded-arm",
        "rad",
        space=TaskSpace(
            start=([-1.5, -1.5], [0.5, 1.5], "rad"),
            rate=([-1, -1], [1, 1], "rad/s"),
            goal=([-1, -2], [1.5, 2], "rad"),
            amplitude=(0, 0.4, "rad"),
            frequency=(0.1, 0.8, "Hz"),
        ),
        task=reach,
        system=simulated(partial(derivative, 0.3), dt),
        model=simulated(partial(derivative, payload), dt).model,
        synthesizer=controllers.Policy(torques),
        distance=distances.FinalState(norm=2, components=(0, 1)),
    )


def sliding_tyres(seed: int) -> Experiment:
    """Return a car that changes lanes at 20 m/s on tyres whose side force levels off; M is linear. 6-D."""
    dt, horizon, speed = 0.06, 50, 20.0

    def derivative(x: Array, u: Array) -> Array:
        heading, side, rate = x[..., 1], x[..., 2], x[..., 3]
        front = 60.0 * np.tanh((u[..., 0] - (side + 1.2 * rate) / speed) / 0.09) * 0.09
        rear = -75.0 * np.tanh((side - 1.4 * rate) / speed / 0.09) * 0.09
        moved = side * np.cos(heading) + speed * np.sin(heading)
        return np.stack([moved, rate, front + rear - speed * rate, (1.2 * front - 1.4 * rear) / 1.6], axis=-1)

    def change(p: Parameters) -> Task:
        place, slope = path(horizon, dt, p.offset, p.lane, p.amplitude, p.frequency)
        still = np.zeros_like(place)
        return Task(
            [p.offset, p.heading, 0.0, p.rate],
            reference=np.stack([place, slope / speed, still, still], axis=-1),
            horizon=horizon,
            dt=dt,
        )

    system = simulated(derivative, dt, substeps=2)
    return experiment(
        "sliding-tyres",
        "m",
        space=TaskSpace(
            offset=(-1.5, 1.5, "m"),
            heading=(-0.06, 0.06, "rad"),
            rate=(-0.15, 0.15, "rad/s"),
            lane=(-2, 2, "m"),
            amplitude=(0, 0.6, "m"),
            frequency=(0.05, 0.4, "Hz"),
        ),
        task=change,
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.05, -0.3, -0.1], [1, 0.05, 0.3, 0.1], [0.03], dt, seed)),
        synthesizer=controllers.LQR([1.0, 10.0, 0.01, 0.5], [20.0]),
        distance=distances.MeanDeviation(components=(0,)),
    )


def boat_in_current(seed: int) -> Experiment:
    """Return a boat that crosses a river whose current, strongest in its middle, M does not know. 5-D."""
    dt, horizon = 0.2, 50
    rudder = float(np.random.default_rng([seed, 19]).uniform(0.9, 1.1))

    def derivative(current: float, gain: float, x: Array, u: Array) -> Array:
        heading, flow = x[..., 2], current * np.exp(-((x[..., 1] / 1.2) ** 2))
        return np.stack(
            [u[..., 0] * np.cos(heading) + flow, u[..., 0] * np.sin(heading), gain * u[..., 1]],
            axis=-1,
        )

    return experiment(
        "boat-in-current",
        "m",
        space=TaskSpace(
            x=(-2, 2, "m"), y=(-2.5, -1, "m"), heading=(0.6, 2.5, "rad"), goal_x=(-1.5, 1.5, "m"), goal_y=(1, 2.5, "m")
        ),
        task=lambda p: Task([p.x, p.y, p.heading], goal=[p.goal_x, p.goal_y, np.pi / 2], horizon=horizon, dt=dt),
        system=simulated(partial(derivative, 0.45, 1.0), dt),
        model=simulated(partial(derivative, 0.0, rudder), dt).model,
        synthesizer=controllers.Policy(partial(_steer, rudder)),
        distance=distances.GoalError(norm=2, components=(0, 1)),
    )


def _steer(gain: float, t: int, x: Array, task: Task) -> Array:
    gap = task.goal[..., :2] - x[..., :2]
    far = np.sqrt((gap**2).sum(axis=-1) + 0.04)
    course = (gap[..., 1] * np.cos(x[..., 2]) - gap[..., 0] * np.sin(x[..., 2])) / far
    return np.stack([0.7 * np.tanh(far / 0.7), 1.5 / gain * course], axis=-1)


def heated_rooms(seed: int) -> Experiment:
    """Return two rooms and the wall between them, with convection and radiation; M is linear, from mild days. 2-D."""
    dt, horizon = 0.25, 40

    def lost(difference: Array) -> Array:
        return difference * (difference**2 + 0.01) ** 0.15

    def derivative(x: Array, u: Array) -> Array:
        one, other, wall = x[..., 0], x[..., 1], x[..., 2]
        through, back = lost(one - wall), lost(other - wall)
        return np.stack(
            [u[..., 0] - through - 0.3 * one, u[..., 1] - back - 0.4 * lost(other), through + back], axis=-1
        )

    system = simulated(derivative, dt)
    return experiment(
        "heated-rooms",
        "10 K",
        space=TaskSpace(start=(-1, 1, "10 K"), goal=(0, 3, "10 K")),
        task=lambda p: Task([p.start, 0.5 * p.start, p.start], goal=[p.goal] * 3, horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [0, 0, 0], [1, 1, 1], [0.6, 0.6], dt, seed)),
        synthesizer=controllers.LQR([1.0, 1.0, 0.0], [0.05, 0.05]),
        distance=distances.FinalState(norm=2),
    )


def levitation(seed: int) -> Experiment:
    """Return a ball under a magnet, of which M is a small Gaussian process. 3-D, LQR linearised at the start."""
    dt, horizon = 0.02, 30

    def derivative(x: Array, u: Array) -> Array:
        gap = np.maximum(x[..., 0], 0.2)
        pulled = GRAVITY * (1 + u[..., 0]) * np.abs(1 + u[..., 0]) / gap**2
        return np.stack([x[..., 1], 0.1 * (GRAVITY - pulled) * 10.0], axis=-1)

    system = simulated(derivative, dt)
    data = record(system, [0.85, -0.5], [1.15, 0.5], [0.15], dt, seed, rollouts=20, steps=6)
    return experiment(
        "levitation",
        "cm",
        space=TaskSpace(start=(0.9, 1.12, "cm"), speed=(-0.3, 0.3, "cm/s"), goal=(0.9, 1.12, "cm")),
        task=lambda p: Task([p.start, p.speed], goal=[p.goal, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.GaussianProcessModel.fit(data, points=15, seed=seed),
        synthesizer=controllers.LQR([50.0, 1.0], [1.0]),
        distance=distances.MeanDeviation(components=(0,)),
    )


REPORTING = listed(
    Entry("quadrotor", "smooth", quadrotor),
    Entry("ball-on-beam", "smooth", ball_on_beam),
    Entry("reactor", "smooth", reactor),
    Entry("loaded-arm", "smooth", loaded_arm),
    Entry("sliding-tyres", "smooth", sliding_tyres),
    Entry("boat-in-current", "smooth", boat_in_current),
    Entry("heated-rooms", "smooth", heated_rooms),
    Entry("levitation", "smooth", levitation),
    *DRAWN,
    *MISLEADING,
)
