"""The reporting systems of strangers that depend on the task, on a place or on the time.

Listed with the others in ``strangers_reporting.py``. The second argument of each function that misleads is the size of
the mechanism; at 0 there is none. M is learned without it.
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


def paid_out_tether(seed: int, pull: float = 4.0) -> Experiment:
    """Return a diver on a tether paid out for its goal, which drags the more the deeper goals are; M has none. 1-D."""
    dt, horizon = 0.2, 40
    depth = drawn(seed, 251, 3.3, 3.5)

    def derivative(x: Array, u: Array, drag: Array) -> Array:
        speed = x[..., 1]
        return np.stack([speed, u[..., 0] - 0.5 * speed - (0.3 + drag) * speed * np.abs(speed)], axis=-1)

    def drag(task: Task) -> Array:
        return pull * np.maximum(task.goal[..., 0] - depth, 0.0)

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "paid-out-tether",
        "m",
        space=TaskSpace(goal=(0.5, 4, "m")),
        task=lambda p: transfer(horizon, dt, row(0.5 + 0 * p.goal), row(p.goal)),
        system=by_task(derivative, drag, dt),
        model=models.Linear.fit(record(nominal, [0, -0.3], [3, 0.3], [0.4], dt, seed)),
        synthesizer=controllers.LQR([4.0, 1.0], [0.5]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def cold_battery(seed: int, loss: float = 0.4) -> Experiment:
    """Return a cart in a plane, whose battery is weak in the coldest tenth of its mornings; M's is warm. 6-D."""
    dt, horizon = 0.08, 40
    warm = drawn(seed, 252, -13.0, -11.0)

    def derivative(x: Array, u: Array, lost: Array) -> Array:
        velocity = x[..., 2:]
        across = 0.3 * velocity[..., ::-1] * np.array([1.0, -1.0]) * velocity[..., :1]
        return np.concatenate(
            [velocity, (1 - lost) * u - velocity - 0.5 * np.abs(velocity) * velocity + across], axis=-1
        )

    def lost(task: Job) -> Array:
        return loss * (task.properties < warm)

    def drive(p: Parameters) -> Task:
        speed = np.concatenate([row(p.speed), 0 * row(p.speed)], axis=-1)
        return Job(transfer(horizon, dt, p.start, p.goal, speed), row(p.morning))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros((*x.shape[:-1], 1))), dt)
    return experiment(
        "cold-battery",
        "m",
        space=TaskSpace(
            start=([-2, -1], [0, 1], "m"),
            speed=(0, 0.8, "m/s"),
            goal=([0, -1], [2, 1], "m"),
            morning=(-15, 25, "degC"),
        ),
        task=drive,
        system=by_task(derivative, lost, dt),
        model=models.Linear.fit(record(nominal, [-2, -1, -0.3, -0.3], [2, 1, 0.3, 0.3], [0.8, 0.8], dt, seed)),
        synthesizer=controllers.LQR([15.0, 15.0, 1.0, 1.0], [0.2, 0.2]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def dull_castings(seed: int, loss: float = 0.35) -> Experiment:
    """Return a kiln whose castings of one thickness and one end temperature absorb less heat; M knows the rest. 4-D."""
    dt, horizon = 0.25, 40
    low = drawn(seed, 253, [8.0, 1.6], [16.0, 2.2])

    def derivative(x: Array, u: Array, lost: Array) -> Array:
        kiln, cast, core = x[..., 0], x[..., 1], x[..., 2]
        into = 0.8 * (1 - lost) * (kiln - cast)
        through = 0.6 * (cast - core)
        return np.stack([u[..., 0] - 0.2 * into - 0.05 * kiln**2, into - through, through], axis=-1)

    def lost(task: Job) -> Array:
        thick, end = task.properties[..., 0], task.goal[..., 1]
        return loss * ((thick > low[0]) & (thick < low[0] + 5) & (end > low[1]) & (end < low[1] + 0.4))

    def heat(p: Parameters) -> Task:
        way = path(horizon, dt, p.cast, p.goal)[0]
        reference = np.stack([way, way, way], axis=-1)
        return Job(Task(row(p.kiln, p.cast, p.cast), reference=reference, horizon=horizon, dt=dt), row(p.thickness))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "dull-castings",
        "100 K",
        space=TaskSpace(kiln=(0, 1.5, "100 K"), cast=(0, 1, "100 K"), goal=(1, 3, "100 K"), thickness=(5, 25, "mm")),
        task=heat,
        system=by_task(derivative, lost, dt),
        model=models.Linear.fit(record(nominal, [0, 0, 0], [1.5, 1, 1], [0.5], dt, seed)),
        synthesizer=controllers.LQR([0.1, 5.0, 1.0], [0.1]),
        distance=distances.MeanDeviation(components=(1,)),
    )


def crossed_elbow(seed: int, bind: float = 3.0) -> Experiment:
    """Return an arm of two links whose hose binds if a task takes its elbow from far left to far right. 4-D."""
    dt, horizon = 0.04, 45
    from_left, to_right = drawn(seed, 254, [-0.8, 0.7], [-0.7, 0.8])

    def derivative(x: Array, u: Array, bound: Array) -> Array:
        rate, cosine = x[..., 2:], np.cos(x[..., 1])
        first, mixed, own = 1.6 + 0.6 * cosine, 0.3 + 0.3 * cosine, 0.3
        sine = 0.3 * np.sin(x[..., 1])
        push = u[..., 0] + sine * rate[..., 1] * (2 * rate[..., 0] + rate[..., 1]) - rate[..., 0]
        pull = u[..., 1] - sine * rate[..., 0] ** 2 - (0.4 + 0.4 * bound) * rate[..., 1]
        turned = np.stack([own * push - mixed * pull, first * pull - mixed * push], axis=-1)
        return np.concatenate([rate, turned / (first * own - mixed**2)[..., None]], axis=-1)

    def bound(task: Task) -> Array:
        return bind * ((task.initial_state[..., 1] < from_left) & (task.goal[..., 1] > to_right))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "crossed-elbow",
        "rad",
        space=TaskSpace(start=([-1, -1.5], [1, 1.5], "rad"), goal=([-1, -1.5], [1, 1.5], "rad")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=by_task(derivative, bound, dt),
        model=models.Linear.fit(record(nominal, [-1, -0.6, -0.3, -0.3], [1, 0.6, 0.3, 0.3], [1.0, 0.5], dt, seed)),
        synthesizer=controllers.LQR([30.0, 30.0, 1.0, 1.0], [0.05, 0.05]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


# Contacts and pockets


def taut_tether(seed: int, stiffness: float = 80.0) -> Experiment:
    """Return a drone whose tether pulls taut beyond a distance from its base, which few tasks reach. 6-D."""
    dt, horizon = 0.07, 40
    length = drawn(seed, 255, 1.46, 1.52)

    def derivative(hard: float, x: Array, u: Array) -> Array:
        velocity, far = x[..., 3:], norm(x[..., :3])
        tension = -hard * np.maximum(far - length, 0.0) * x[..., :3] / far
        return np.concatenate([velocity, u - 0.3 * velocity - 0.3 * norm(velocity) * velocity + tension], axis=-1)

    low, high = [-0.6, -0.6, 0, -0.4, -0.4, -0.4], [0.6, 0.6, 0.6, 0.4, 0.4, 0.4]
    return experiment(
        "taut-tether",
        "m",
        space=TaskSpace(start=([-0.7, -0.7, 0], [0.7, 0.7, 0.7], "m"), goal=([-1, -1, 0], [1, 1, 1], "m")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=simulated(partial(derivative, stiffness), dt, substeps=2),
        model=models.Linear.fit(record(simulated(partial(derivative, 0.0), dt), low, high, [0.8] * 3, dt, seed)),
        synthesizer=controllers.LQR([20.0] * 3 + [1.0] * 3, [0.2] * 3),
        distance=distances.MeanDeviation(components=(0, 1, 2)),
    )


def table_top(seed: int, stiffness: float = 400.0) -> Experiment:
    """Return an arm of two links whose tip meets a table under the deepest of its ways; M is learned above. 4-D."""
    dt, horizon = 0.04, 45
    height = drawn(seed, 256, -1.12, -1.09)

    def derivative(hard: float, x: Array, u: Array) -> Array:
        first, both, rate = x[..., 0], x[..., 0] + x[..., 1], x[..., 2:]
        depth = np.maximum(height - 0.7 * np.sin(first) - 0.6 * np.sin(both), 0.0)
        lever = np.stack([0.7 * np.cos(first) + 0.6 * np.cos(both), 0.6 * np.cos(both)], axis=-1)
        coupled = 0.4 * np.sin(x[..., 1:2]) * rate * rate[..., ::-1] * np.array([1.0, -1.0])
        return np.concatenate([rate, u - rate + coupled + hard * depth[..., None] * lever], axis=-1)

    nominal = simulated(partial(derivative, 0.0), dt)
    return experiment(
        "table-top",
        "rad",
        space=TaskSpace(start=([-0.6, -0.8], [0.8, 0.8], "rad"), goal=([-0.9, -0.8], [0.5, 0.8], "rad")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=simulated(partial(derivative, stiffness), dt, substeps=2),
        model=models.Linear.fit(record(nominal, [-0.2, -0.5, -0.3, -0.3], [0.6, 0.5, 0.3, 0.3], [1.0, 1.0], dt, seed)),
        synthesizer=controllers.LQR([30.0, 30.0, 1.0, 1.0], [0.1, 0.1]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def thin_pillar(seed: int, stiffness: float = 700.0) -> Experiment:
    """Return a turning robot in a plane, with a pillar at the edge of its room, which very few tasks graze. 5-D."""
    dt, horizon, radius = 0.06, 40, 0.07
    place = pillar_place(seed)

    def derivative(hard: float, x: Array, u: Array) -> Array:
        velocity, away = x[..., 3:5], x[..., :2] - place
        far = norm(away)
        grazed = hard * np.maximum(radius - far, 0.0)
        moved = u[..., :2] - 0.4 * velocity - 0.4 * norm(velocity) * velocity + grazed * away / far
        turned = u[..., 2] - x[..., 5] - 0.3 * x[..., 5] ** 3 + 0.5 * grazed[..., 0]
        return np.concatenate([x[..., 3:], moved, turned[..., None]], axis=-1)

    def roam(p: Parameters) -> Task:
        start, goal = (np.concatenate([a, row(b)], axis=-1) for a, b in ((p.start, 0 * p.turn), (p.goal, p.turn)))
        return transfer(horizon, dt, start, goal)

    low, high = [-1, -1, -0.5, -0.3, -0.3, -0.3], [1, 0.5, 0.5, 0.3, 0.3, 0.3]
    return experiment(
        "thin-pillar",
        "m",
        space=TaskSpace(start=([-1, -1], [1, 0.5], "m"), goal=([-1, -1], [1, 1], "m"), turn=(-1, 1, "rad")),
        task=roam,
        system=simulated(partial(derivative, stiffness), dt, substeps=2),
        model=models.Linear.fit(record(simulated(partial(derivative, 0.0), dt), low, high, [0.8] * 3, dt, seed)),
        synthesizer=controllers.LQR([20.0] * 3 + [1.0] * 3, [0.15] * 3),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def pillar_place(seed: int) -> Array:
    """Return where the pillar of a seed stands."""
    return np.asarray(drawn(seed, 257, [-0.95, 0.9], [-0.85, 0.95]))


def near_pillar(seed: int) -> Array:
    """Return tasks with their goal at or behind the pillar of a seed."""
    rng = np.random.default_rng(seed)
    goals = np.clip(pillar_place(seed) + rng.normal(0, 0.06, (40, 2)), -1, 1)
    return np.concatenate([rng.uniform([-1, -1], [1, 0.5], (40, 2)), goals, rng.uniform(-1, 1, (40, 1))], axis=1)


def small_eddy(seed: int, swirl: float = 9.0) -> Experiment:
    """Return a swimming robot in a basin with one small eddy behind a groyne; M knows still water. 5-D."""
    dt, horizon, size = 0.08, 40, 0.16
    place = drawn(seed, 258, [0.7, -0.9], [0.8, -0.8])

    def derivative(strength: float, x: Array, u: Array) -> Array:
        velocity, away = x[..., 2:], x[..., :2] - place
        around = away[..., ::-1] * np.array([-1.0, 1.0])
        flow = strength * around * np.maximum(1 - (away**2).sum(axis=-1, keepdims=True) / size**2, 0.0)
        through = velocity - flow
        return np.concatenate([velocity, u - 0.5 * through - 1.2 * norm(through) * through], axis=-1)

    def swim(p: Parameters) -> Task:
        return transfer(horizon, dt, np.stack(np.broadcast_arrays(-1.0, p.start), axis=-1), p.goal, p.speed)

    nominal = simulated(partial(derivative, 0.0), dt)
    return experiment(
        "small-eddy",
        "m",
        space=TaskSpace(start=(-1, 1, "m"), speed=([-0.3] * 2, [0.3] * 2, "m/s"), goal=([-0.5, -1], [1, 1], "m")),
        task=swim,
        system=simulated(partial(derivative, swirl), dt),
        model=models.Linear.fit(record(nominal, [-1, -1, -0.3, -0.3], [1, 1, 0.3, 0.3], [0.8, 0.8], dt, seed)),
        synthesizer=controllers.LQR([15.0, 15.0, 1.0, 1.0], [0.2, 0.2]),
        distance=distances.FinalState(norm=2, components=(0, 1)),
    )


# Wind by time


def rising_breeze(seed: int, strength: float = 0.5) -> Experiment:
    """Return a sailing drone in a breeze that rises and veers with the time of the task; M knows a lull. 4-D."""
    dt, horizon = 0.1, 50
    veer = drawn(seed, 259, 0.5, 0.9)

    def derivative(wind: float, x: Array, u: Array, seconds: float) -> Array:
        velocity, angle = x[..., 2:], veer * seconds
        air = wind * seconds / 5.0 * np.array([np.cos(angle), np.sin(angle)])
        through = velocity - air
        return np.concatenate([velocity, u - 0.3 * through - 0.8 * norm(through) * through], axis=-1)

    nominal = simulated(lambda x, u: derivative(0.0, x, u, 0.0), dt)
    return experiment(
        "rising-breeze",
        "m",
        space=TaskSpace(start=([-1.5] * 2, [0, 1.5], "m"), goal=([0, -1.5], [1.5] * 2, "m")),
        task=lambda p: transfer(horizon, dt, p.start, p.goal),
        system=by_time(partial(derivative, strength), dt),
        model=models.Linear.fit(record(nominal, [-1.5, -1.5, -0.3, -0.3], [1.5, 1.5, 0.3, 0.3], [0.5] * 2, dt, seed)),
        synthesizer=controllers.LQR([5.0, 5.0, 1.0, 1.0], [0.5, 0.5]),
        distance=distances.FinalState(norm=2, components=(0, 1)),
    )


def passing_truck(seed: int, push: float = 3.0) -> Experiment:
    """Return a scooter that a truck's bow wave pushes at one time, if it is in the left lane then. 4-D."""
    dt, horizon, speed = 0.06, 50, 8.0
    passes = drawn(seed, 260, 1.0, 1.6)

    def derivative(wave: float, x: Array, u: Array, seconds: float) -> Array:
        side, heading, lean = x[..., 0], x[..., 1], x[..., 2]
        blown = wave * (passes <= seconds < passes + 0.4) * np.clip((side - 1.2) / 0.3, 0, 1)
        return np.stack([speed * np.sin(heading) - blown, np.tan(lean), 5.0 * (u[..., 0] - np.sin(lean))], axis=-1)

    def ride(p: Parameters) -> Task:
        place, slope = path(horizon, dt, p.lane, p.goal)
        reference = np.stack([place, slope / speed, 0 * place], axis=-1)
        return Task(row(p.lane, p.heading, p.lean), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(lambda x, u: derivative(0.0, x, u, 0.0), dt)
    return experiment(
        "passing-truck",
        "m",
        space=TaskSpace(
            lane=(-1.5, 1.5, "m"), heading=(-0.15, 0.15, "rad"), lean=(-0.3, 0.3, "rad"), goal=(-1.5, 1.5, "m")
        ),
        task=ride,
        system=by_time(partial(derivative, push), dt, substeps=2),
        model=models.Linear.fit(record(nominal, [-1, -0.1, -0.15], [1, 0.1, 0.15], [0.15], dt, seed, steps=10)),
        synthesizer=controllers.LQR([1.0, 5.0, 0.5], [1.0]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


TASKS = (
    stranger("paid-out-tether", "task", paid_out_tether),
    stranger("cold-battery", "task", cold_battery),
    stranger("dull-castings", "task", dull_castings),
    stranger("crossed-elbow", "task", crossed_elbow),
    stranger("taut-tether", "contact", taut_tether),
    stranger("table-top", "contact", table_top),
    stranger("thin-pillar", "pocket", thin_pillar, hints=near_pillar),
    stranger("small-eddy", "pocket", small_eddy),
    stranger("rising-breeze", "wind", rising_breeze),
    stranger("passing-truck", "wind", passing_truck),
)
