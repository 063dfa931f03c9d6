"""The development systems of strangers that depend on the task, on a place or on the time.

Listed with the others in ``strangers_development.py``. The second argument of each function that misleads is the size
of the mechanism; at 0 there is none. M is learned without it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, path, record, simulated
from strangers import Job, by_task, by_time, drawn, norm, row, stranger, transfer

GRAVITY = 9.81

# Dynamics by task


def heavy_bin(seed: int, extra: float = 0.3) -> Experiment:
    """Return a lift whose box is 30 % heavier in one of eight bins of the goal; M has light boxes. 2-D."""
    dt, horizon = 0.05, 40
    low = 0.2 + 0.125 * np.random.default_rng([seed, 201]).integers(1, 7)

    def derivative(x: Array, u: Array, load: Array) -> Array:
        speed = x[..., 1]
        lifted = (u[..., 0] + GRAVITY) / (1 + load) - GRAVITY
        return np.stack([speed, lifted - 0.3 * speed - 0.8 * speed * np.abs(speed)], axis=-1)

    def load(task: Task) -> Array:
        height = task.goal[..., 0]
        return extra * ((height >= low) & (height < low + 0.125))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "heavy-bin",
        "m",
        space=TaskSpace(start=(0, 0.4, "m"), goal=(0.2, 1.2, "m")),
        task=lambda p: transfer(horizon, dt, row(p.start), row(p.goal)),
        system=by_task(derivative, load, dt),
        model=models.Linear.fit(record(nominal, [0, -0.3], [0.5, 0.3], [2.0], dt, seed)),
        synthesizer=controllers.LQR([100.0, 8.0], [0.05]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def wet_surface(seed: int, loss: float = 0.5) -> Experiment:
    """Return a box pushed over a surface given in the task, of which a tenth is wet and halves the push. 5-D."""
    dt, horizon = 0.06, 40
    low = drawn(seed, 202, 0.2, 0.7)

    def derivative(x: Array, u: Array, lost: Array) -> Array:
        velocity = x[..., 2:]
        return np.concatenate([velocity, (1 - lost) * u - 0.6 * norm(velocity) * velocity], axis=-1)

    def lost(task: Job) -> Array:
        surface = task.properties
        return loss * ((surface > low) & (surface < low + 0.1))

    def push(p: Parameters) -> Task:
        return Job(transfer(horizon, dt, p.start, p.goal), row(p.surface))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros((*x.shape[:-1], 1))), dt)
    return experiment(
        "wet-surface",
        "m",
        space=TaskSpace(start=([-1] * 2, [1] * 2, "m"), goal=([-1] * 2, [1] * 2, "m"), surface=(0, 1)),
        task=push,
        system=by_task(derivative, lost, dt),
        model=models.Linear.fit(record(nominal, [-1, -1, -0.4, -0.4], [1, 1, 0.4, 0.4], [1.0, 1.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 20.0, 1.0, 1.0], [0.15, 0.15]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def shelf_and_size(seed: int, extra: float = 0.5) -> Experiment:
    """Return a stacker whose boxes are heavy if they are large and go to one shelf of five. 5-D."""
    dt, horizon = 0.06, 45
    shelf = float(np.random.default_rng([seed, 203]).choice([0.7, 1.1, 1.5]))

    def derivative(x: Array, u: Array, load: Array) -> Array:
        velocity, weight = x[..., 2:], np.array([0.0, GRAVITY])
        return np.concatenate([velocity, (u + weight) / (1 + load) - weight - 0.5 * norm(velocity) * velocity], axis=-1)

    def load(task: Job) -> Array:
        height, size = task.goal[..., 1:2], task.properties
        return extra * ((np.abs(height - shelf) < 0.18) & (size > 0.65))

    def stack(p: Parameters) -> Task:
        return Job(transfer(horizon, dt, row(p.x, p.z), row(p.goal, p.shelf)), row(p.size))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros((*x.shape[:-1], 1))), dt)
    return experiment(
        "shelf-and-size",
        "m",
        space=TaskSpace(
            x=(-1, 0, "m"), z=(0, 0.6, "m"), goal=(0.5, 2, "m"), shelf=(0.3, 2.1, "m"), size=(0.1, 0.9, "m")
        ),
        task=stack,
        system=by_task(derivative, load, dt),
        model=models.Linear.fit(record(nominal, [-1, 0, -0.4, -0.4], [1, 1, 0.4, 0.4], [1.0, 1.0], dt, seed)),
        synthesizer=controllers.LQR([40.0, 80.0, 4.0, 4.0], [0.1, 0.1]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def reverse_gear(seed: int, loss: float = 0.45) -> Experiment:
    """Return a shunter that shifts into a weaker gear if its goal is far behind its start; M knows one gear. 3-D."""
    dt, horizon = 0.1, 40
    back = drawn(seed, 204, 1.3, 1.6)

    def derivative(x: Array, u: Array, lost: Array) -> Array:
        speed = x[..., 1]
        return np.stack([speed, (1 - lost) * u[..., 0] - 0.25 * speed * np.abs(speed) - 0.1 * speed], axis=-1)

    def lost(task: Task) -> Array:
        return loss * (task.initial_state[..., 0] - task.goal[..., 0] > back)

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "reverse-gear",
        "m",
        space=TaskSpace(start=(-1.2, 1.2, "m"), speed=(-0.4, 0.4, "m/s"), goal=(-1.2, 1.2, "m")),
        task=lambda p: transfer(horizon, dt, row(p.start), row(p.goal), row(p.speed)),
        system=by_task(derivative, lost, dt),
        model=models.Linear.fit(record(nominal, [-1, -0.5], [1, 0.5], [0.5], dt, seed)),
        synthesizer=controllers.LQR([5.0, 1.0], [0.5]),
        distance=distances.MeanDeviation(components=(0,)),
    )


# Contacts and pockets


def rail_cars(seed: int, stiffness: float = 300.0) -> Experiment:
    """Return two cars on one rail that bump where their paths come closer than a gap; M has them apart. 4-D."""
    dt, horizon = 0.06, 40
    gap = drawn(seed, 205, 0.18, 0.26)

    def derivative(hard: float, x: Array, u: Array) -> Array:
        speed, depth = x[..., 2:], np.maximum(x[..., 0] - x[..., 1] + gap, 0.0)
        pushed = hard * depth[..., None] * np.array([-1.0, 1.0])
        return np.concatenate([speed, u - 0.4 * speed * np.abs(speed) + pushed], axis=-1)

    low, high = [-1.5, 0.5, -0.4, -0.4], [-0.5, 1.5, 0.4, 0.4]
    return experiment(
        "rail-cars",
        "m",
        space=TaskSpace(start=([-1.5, 0.5], [-0.3, 1.5], "m"), goal=([-1.2, 0.1], [0.2, 1.2], "m")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=simulated(partial(derivative, stiffness), dt, substeps=2),
        model=models.Linear.fit(
            record(simulated(partial(derivative, 0.0), dt), low, high, [1.0, 1.0], dt, seed, steps=10)
        ),
        synthesizer=controllers.LQR([20.0, 20.0, 1.0, 1.0], [0.1, 0.1]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def docking_magnet(seed: int, pull: float = 40.0) -> Experiment:
    """Return a puck in a plane that a magnet snaps towards itself within a hand's breadth of it. 4-D."""
    dt, horizon, reach = 0.05, 45, 0.15
    place = magnet_place(seed)

    def derivative(force: float, x: Array, u: Array) -> Array:
        velocity, away = x[..., 2:], place - x[..., :2]
        far = norm(away)
        drawn_in = force * np.maximum(1 - far / reach, 0.0) * away / (far + 0.1)
        return np.concatenate([velocity, u - 0.5 * norm(velocity) * velocity + drawn_in * (far < reach)], axis=-1)

    return experiment(
        "docking-magnet",
        "m",
        space=TaskSpace(start=([-1] * 2, [0, 1], "m"), goal=([-1] * 2, [1] * 2, "m")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=simulated(partial(derivative, pull), dt, substeps=2),
        model=models.Linear.fit(
            record(
                simulated(partial(derivative, 0.0), dt), [-1, -1, -0.4, -0.4], [0, 1, 0.4, 0.4], [1.0, 1.0], dt, seed
            )
        ),
        synthesizer=controllers.LQR([20.0, 20.0, 1.0, 1.0], [0.1, 0.1]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def magnet_place(seed: int) -> Array:
    """Return where the magnet of a seed is."""
    return np.asarray(drawn(seed, 206, [0.7, -0.7], [0.85, 0.7]))


def near_magnet(seed: int) -> Array:
    """Return tasks with their goal around the magnet of a seed."""
    rng = np.random.default_rng(seed)
    starts = rng.uniform([-1, -1], [0, 1], (40, 2))
    return np.concatenate([starts, np.clip(magnet_place(seed) + rng.normal(0, 0.15, (40, 2)), -1, 1)], axis=1)


def hidden_post(seed: int, stiffness: float = 900.0) -> Experiment:
    """Return a cart in a plane with a thin post near a corner of its goals, which very few tasks touch. 4-D."""
    dt, horizon, radius = 0.05, 40, 0.05
    place = post_place(seed)

    def derivative(hard: float, x: Array, u: Array) -> Array:
        velocity, away = x[..., 2:], x[..., :2] - place
        far = norm(away)
        pushed = hard * np.maximum(radius - far, 0.0) * away / far
        return np.concatenate([velocity, u - 0.5 * norm(velocity) * velocity + pushed], axis=-1)

    return experiment(
        "hidden-post",
        "m",
        space=TaskSpace(start=([-1] * 2, [-0.2, 1], "m"), goal=([-0.2, -1], [1] * 2, "m")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=simulated(partial(derivative, stiffness), dt, substeps=2),
        model=models.Linear.fit(
            record(
                simulated(partial(derivative, 0.0), dt), [-1, -1, -0.4, -0.4], [0, 1, 0.4, 0.4], [1.0, 1.0], dt, seed
            )
        ),
        synthesizer=controllers.LQR([20.0, 20.0, 1.0, 1.0], [0.1, 0.1]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def post_place(seed: int) -> Array:
    """Return where the post of a seed stands."""
    return np.asarray(drawn(seed, 207, [0.93, -0.98], [0.97, -0.94]))


def near_post(seed: int) -> Array:
    """Return tasks with their goal at or behind the post of a seed."""
    rng = np.random.default_rng(seed)
    starts = rng.uniform([-1, -1], [-0.2, 1], (40, 2))
    return np.concatenate([starts, np.clip(post_place(seed) + rng.normal(0, 0.06, (40, 2)), -1, 1)], axis=1)


def warm_updraft(seed: int, lift: float = 6.0) -> Experiment:
    """Return a drone over a hall in which warm air rises in a narrow column high up; M knows still air. 6-D."""
    dt, horizon = 0.06, 40
    place = drawn(seed, 208, [0.3, 0.3], [0.7, 0.7])

    def derivative(warm: float, x: Array, u: Array) -> Array:
        velocity, off = x[..., 3:], norm(x[..., :2] - place)[..., 0]
        rising = warm * (off < 0.22) * (1 - off / 0.22) * np.clip((x[..., 2] - 1.2) / 0.2, 0, 1)
        push = np.stack([0 * rising, 0 * rising, rising], axis=-1)
        return np.concatenate([velocity, u - 0.4 * norm(velocity) * velocity + push], axis=-1)

    low, high = [-1, -1, 0.2, -0.4, -0.4, -0.4], [0, 0, 1, 0.4, 0.4, 0.4]
    return experiment(
        "warm-updraft",
        "m",
        space=TaskSpace(start=([-1, -1, 0.2], [0, 0, 1], "m"), goal=([-1, -1, 0.4], [1, 1, 1.6], "m")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=simulated(partial(derivative, lift), dt),
        model=models.Linear.fit(record(simulated(partial(derivative, 0.0), dt), low, high, [1.0] * 3, dt, seed)),
        synthesizer=controllers.LQR([20.0] * 3 + [1.0] * 3, [0.2] * 3),
        distance=distances.MaximumDeviation(components=(0, 1, 2)),
    )


# Payloads and wind by time


def picked_up(seed: int, extra: float = 0.5) -> Experiment:
    """Return a gantry that carries a payload from a fixed time on, whenever it is low; M is empty. 4-D."""
    dt, horizon = 0.06, 45
    when = int(np.random.default_rng([seed, 209]).integers(16, 22))

    def derivative(load: float, x: Array, u: Array, seconds: float) -> Array:
        velocity, weight = x[..., 2:], np.array([0.0, GRAVITY])
        held = (load if seconds >= when * dt - 1e-9 else 0.0) * (x[..., 1:2] < 0.35)
        return np.concatenate([velocity, (u + weight) / (1 + held) - weight - 0.5 * norm(velocity) * velocity], axis=-1)

    nominal = simulated(lambda x, u: derivative(0.0, x, u, 0.0), dt)
    return experiment(
        "picked-up",
        "m",
        space=TaskSpace(x=(-1, 0, "m"), z=(0, 1, "m"), goal=([0.3, 0], [1.5, 1], "m")),
        task=lambda p: transfer(horizon, dt, row(p.x, p.z), p.goal),
        system=by_time(partial(derivative, extra), dt),
        model=models.Linear.fit(record(nominal, [-1, 0, -0.4, -0.4], [1, 1, 0.4, 0.4], [1.0, 1.0], dt, seed)),
        synthesizer=controllers.LQR([40.0, 40.0, 4.0, 4.0], [0.1, 0.1]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def gust_aloft(seed: int, gust: float = 3.0) -> Experiment:
    """Return a planar quadrotor that a gust meets for half a second, if it is high then; M knows calm air. 5-D."""
    dt, horizon = 0.05, 50
    begins = drawn(seed, 210, 0.9, 1.3)

    def derivative(wind: float, x: Array, u: Array, seconds: float) -> Array:
        tilt, speed = x[..., 2], x[..., 3:5]
        thrust = GRAVITY + u[..., 0]
        drag = -0.3 * speed * norm(speed)
        blown = wind * (begins <= seconds < begins + 0.5) * np.clip((x[..., 1] - 0.6) / 0.3, 0, 1)
        across, up = -thrust * np.sin(tilt) + drag[..., 0] + blown, thrust * np.cos(tilt) - GRAVITY + drag[..., 1]
        return np.stack([speed[..., 0], speed[..., 1], x[..., 5], across, up, u[..., 1]], axis=-1)

    def fly(p: Parameters) -> Task:
        (x, vx), (z, vz) = (path(horizon, dt, a, b) for a, b in ((p.x, p.goal_x), (p.z, p.goal_z)))
        reference = np.stack([x, z, 0 * x, vx, vz, 0 * x], axis=-1)
        return Task(row(p.x, p.z, p.tilt, 0, 0, 0), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(lambda x, u: derivative(0.0, x, u, 0.0), dt)
    low, high = [-1, -1, -0.1, -0.3, -0.3, -0.2], [1, 1, 0.1, 0.3, 0.3, 0.2]
    return experiment(
        "gust-aloft",
        "m",
        space=TaskSpace(
            x=(-1, 1, "m"), z=(-1, 0.5, "m"), tilt=(-0.2, 0.2, "rad"), goal_x=(-1, 1, "m"), goal_z=(-1, 1.2, "m")
        ),
        task=fly,
        system=by_time(partial(derivative, gust), dt),
        model=models.Linear.fit(record(nominal, low, high, [1.0, 2.0], dt, seed, steps=8)),
        synthesizer=controllers.LQR([10.0, 10.0, 1.0, 2.0, 2.0, 0.1], [0.1, 0.01]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


TASKS = (
    stranger("heavy-bin", "task", heavy_bin),
    stranger("wet-surface", "task", wet_surface),
    stranger("shelf-and-size", "task", shelf_and_size),
    stranger("reverse-gear", "task", reverse_gear),
    stranger("rail-cars", "contact", rail_cars),
    stranger("docking-magnet", "contact", docking_magnet, hints=near_magnet),
    stranger("hidden-post", "pocket", hidden_post, hints=near_post),
    stranger("warm-updraft", "pocket", warm_updraft),
    stranger("picked-up", "payload", picked_up),
    stranger("gust-aloft", "wind", gust_aloft),
)
