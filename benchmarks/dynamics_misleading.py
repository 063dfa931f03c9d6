"""The systems to report on that violate an assumption of a certificate from learned dynamics, and one with noise.

Listed with the others in ``dynamics_reporting.py``. Each takes the mechanism that misleads as an option, so that
``dynamics_check.py`` can measure what it changes. Shares of tasks in docstrings are those of 20,000 random tasks whose
distance it changes by more than a quarter of the median distance without it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models, systems
from ctxval._util.arrays import Array
from dynamics_systems import Entry, Noisy, PartlySeen, experiment, friction, path, record, repeated, simulated


def crane(seed: int, payload: float = 0.3) -> Experiment:
    """Return a crane's trolley whose payload swings, which is not recorded. 5-D.

    The payload changes nearly all tasks, and the largest distance 4 times.
    """
    dt, horizon = 0.08, 60

    def derivative(x: Array, u: Array) -> Array:
        speed, swing, rate = x[..., 1], x[..., 2], x[..., 3]
        sine, cosine = np.sin(swing), np.cos(swing)
        pull = u[..., 0] - 0.2 * speed * np.abs(speed) + payload * sine * (rate**2 + 9.81 * cosine)
        moved = pull / (1 + payload * sine**2)
        return np.stack([speed, moved, rate, -moved * cosine - 9.81 * sine - 0.1 * rate], axis=-1)

    def carry(p: Parameters) -> Task:
        reference = np.stack(path(horizon, dt, p.start, p.goal, p.amplitude, p.frequency), axis=-1)
        return Task([p.start, p.speed], reference=reference, horizon=horizon, dt=dt)

    system = PartlySeen(derivative, dt, hidden=2)
    return experiment(
        "crane",
        "m",
        space=TaskSpace(
            start=(-1, 1, "m"),
            speed=(-0.5, 0.5, "m/s"),
            goal=(-1.5, 1.5, "m"),
            amplitude=(0, 0.3, "m"),
            frequency=(0.1, 0.8, "Hz"),
        ),
        task=carry,
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.3], [1, 0.3], [0.5], dt, seed, steps=10)),
        synthesizer=controllers.LQR([5.0, 1.0], [0.5]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def backlash(seed: int, play: float = 0.08) -> Experiment:
    """Return a turntable behind a gear with play; the motor's angle, which takes the play up, is not recorded. 3-D.

    The play changes 81 % of the tasks, and d* 1.2 times.
    """
    dt, horizon = 0.05, 50

    def derivative(x: Array, u: Array) -> Array:
        rate, lead = x[..., 1], x[..., 2]
        tooth = np.maximum(lead - play, 0.0) + np.minimum(lead + play, 0.0)
        turned = 60.0 * tooth - 3.0 * rate - 0.5 * rate * np.abs(rate)
        return np.stack([rate, turned, u[..., 0] - rate], axis=-1)

    def turn(p: Parameters) -> Task:
        reference = np.stack(path(horizon, dt, p.start, 0.0 * p.start, p.amplitude, p.frequency), axis=-1)
        return Task([p.start, 0.0], reference=reference, horizon=horizon, dt=dt)

    system = PartlySeen(derivative, dt, hidden=1)
    return experiment(
        "backlash",
        "rad",
        space=TaskSpace(start=(-1.5, 1.5, "rad"), amplitude=(0, 0.6, "rad"), frequency=(0.2, 1.0, "Hz")),
        task=turn,
        system=system,
        model=models.Linear.fit(record(system, [-0.5, -0.5], [0.5, 0.5], [1.0], dt, seed)),
        synthesizer=controllers.LQR([10.0, 0.5], [1.0]),
        distance=distances.MeanDeviation(components=(0,)),
    )


def oblique_wall(seed: int, stiffness: float = 600.0) -> Experiment:
    """Return a gripper that moves in a plane, with a slanting wall behind one corner of its goals. 6-D.

    The wall changes 0.2 % of the tasks, and d* 2.4 times.
    """
    dt, horizon, normal = 0.05, 40, np.array([0.8, 0.6])

    def derivative(x: Array, u: Array) -> Array:
        velocity = x[..., 2:]
        depth = np.maximum(x[..., :2] @ normal - 1.1, 0.0)
        speed = np.sqrt((velocity**2).sum(axis=-1, keepdims=True) + 1e-6)
        push = u - 0.4 * speed * velocity - stiffness * depth[..., None] * normal
        return np.concatenate([velocity, push], axis=-1)

    def move(p: Parameters) -> Task:
        still = np.zeros_like(p.goal)
        start, goal = (np.concatenate(pair, axis=-1) for pair in ((p.start, p.speed), (p.goal, still)))
        return Task(start, goal=goal, horizon=horizon, dt=dt)

    system = simulated(derivative, dt, substeps=2)
    return experiment(
        "oblique-wall",
        "m",
        space=TaskSpace(
            start=([-1, -1], [0.7, 0.7], "m"), speed=([-1.5] * 2, [1.5] * 2, "m/s"), goal=([-1, -1], [0.8, 0.8], "m")
        ),
        task=move,
        system=system,
        model=models.Linear.fit(record(system, [-1, -1, -0.5, -0.5], [0, 0, 0.5, 0.5], [1.0, 1.0], dt, seed)),
        synthesizer=controllers.LQR([10.0, 10.0, 1.0, 1.0], [1.0, 1.0]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def dry_sled(seed: int, grip: float = 1.0) -> Experiment:
    """Return a sled in a plane with dry friction, which stops it short; M is learned while it moves. 4-D.

    The friction changes 90 % of the tasks, and the largest distance twice.
    """
    dt, horizon, substeps = 0.06, 40, 3
    h = dt / substeps

    def step(x: Array, u: Array) -> Array:
        velocity = friction(x[..., 2:], u - 0.05 * x[..., 2:] ** 3, grip, h)
        return np.concatenate([x[..., :2] + h * velocity, velocity], axis=-1)

    system = systems.Simulated(repeated(step, substeps), vectorized=True)
    return experiment(
        "dry-sled",
        "m",
        space=TaskSpace(start=([-1] * 2, [1] * 2, "m"), goal=([-1] * 2, [1] * 2, "m")),
        task=lambda p: Task(
            [p.start[..., 0], p.start[..., 1], 0.0, 0.0],
            goal=[p.goal[..., 0], p.goal[..., 1], 0.0, 0.0],
            horizon=horizon,
            dt=dt,
        ),
        system=system,
        model=models.Linear.fit(record(system, [-1, -1, 0.5, 0.5], [1, 1, 1.5, 1.5], [1.0, 1.0], dt, seed, steps=6)),
        synthesizer=controllers.LQR([10.0, 8.0, 1.0, 1.0], [0.5, 0.5]),
        distance=distances.GoalError(norm=2, components=(0, 1)),
    )


def full_wheel(seed: int, limit: float = 2.3) -> Experiment:
    """Return a satellite whose reaction wheel gives no more torque beyond a speed that few tasks reach. 4-D.

    The limit changes 3 % of the tasks, and d* 45 times.
    """
    dt, horizon = 0.1, 50

    def step(x: Array, u: Array) -> Array:
        wheel = np.clip(x[..., 2] + dt * u[..., 0], -limit, limit)
        turn = (wheel - x[..., 2]) - 0.02 * dt * x[..., 1] * np.abs(x[..., 1])
        rate = x[..., 1] + turn + 0.05 * dt * np.sin(2 * x[..., 0])
        return np.stack([x[..., 0] + dt * rate, rate, wheel], axis=-1)

    system = systems.Simulated(step, vectorized=True)
    return experiment(
        "full-wheel",
        "rad",
        space=TaskSpace(
            angle=(-1, 1, "rad"), rate=(-0.5, 0.5, "rad/s"), wheel=(-1.7, 1.7, "rad/s"), goal=(-1.5, 1.5, "rad")
        ),
        task=lambda p: Task([p.angle, p.rate, p.wheel], goal=[p.goal, 0.0, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [-0.5, -0.2, -0.5], [0.5, 0.2, 0.5], [0.5], dt, seed)),
        synthesizer=controllers.LQR([4.0, 1.0, 0.0], [0.3]),
        distance=distances.FinalState(components=(0,)),
    )


def icy_corner(seed: int, hold: float = 0.15) -> Experiment:
    """Return a vehicle in a plane that loses its grip where a corner is icy, if it comes there fast. 5-D.

    The ice changes 0.3 % of the tasks, and d* 4 times.
    """
    dt, horizon = 0.05, 50

    def derivative(x: Array, u: Array) -> Array:
        velocity = x[..., 2:]
        speed = np.sqrt((velocity**2).sum(axis=-1))
        icy = (x[..., 0] > 0.3) & (x[..., 1] < -0.2) & (speed > 1.1)
        gripped = np.where(icy, hold, 1.0)[..., None] * u
        return np.concatenate([velocity, gripped - 0.3 * speed[..., None] * velocity], axis=-1)

    system = simulated(derivative, dt)
    return experiment(
        "icy-corner",
        "m",
        space=TaskSpace(
            x=(-1, 0.2, "m"),
            y=(-1, 1, "m"),
            speed=(-0.5, 1.6, "m/s"),
            goal=([-1, -1], [0.8, 1], "m"),
        ),
        task=lambda p: Task(
            [p.x, p.y, p.speed, 0.0], goal=[p.goal[..., 0], p.goal[..., 1], 0.0, 0.0], horizon=horizon, dt=dt
        ),
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.5, -0.5, -0.5], [0, 0.5, 0.5, 0.5], [1.0, 1.0], dt, seed)),
        synthesizer=controllers.LQR([6.0, 6.0, 1.0, 1.0], [1.0, 1.0]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def over_the_hill(seed: int, height: float = 1.03, engine: float = 1.21) -> Experiment:
    """Return a truck that takes a hill by its run-up; M takes it in all tasks, S rolls back in a few. 3-D.

    Distances are above 0.5 m in 8 of 10,000 tasks, and 0.003 m in the median.
    """
    dt, horizon = 0.1, 60
    known = float(np.random.default_rng([seed, 37]).uniform(0.99, 1.0))

    def derivative(steepness: float, x: Array, u: Array) -> Array:
        place, speed = x[..., 0], x[..., 1]
        slope = -4.0 * place * np.exp(-2.0 * place**2) * steepness
        return np.stack([speed, u[..., 0] - 1.6 * slope - 0.2 * speed], axis=-1)

    return experiment(
        "over-the-hill",
        "m",
        space=TaskSpace(start=(-2.2, -1.6, "m"), speed=(0, 1, "m/s"), goal=(1, 2, "m")),
        task=lambda p: Task([p.start, p.speed], goal=[p.goal, 0.0], horizon=horizon, dt=dt),
        system=simulated(partial(derivative, height), dt),
        model=simulated(partial(derivative, known), dt).model,
        synthesizer=controllers.Policy(_drive, limits=engine),
        distance=distances.FinalState(components=(0,)),
    )


def _drive(t: int, x: Array, task: Task) -> Array:
    return np.asarray((3.0 * (task.goal[..., 0] - x[..., 0]) - 2.5 * x[..., 1])[..., None])


ROVER_NOISE = (0.01, 0.01, 0.005)


def gravel_rover(seed: int, deviation: tuple[float, ...] = ROVER_NOISE) -> Experiment:
    """Return a rover on gravel, pushed about at random by a declared amount; M steers without slip. 4-D.

    The noise changes 55 % of the tasks, and the largest distance 1.3 times.
    """
    dt, horizon = 0.2, 40
    gain = float(np.random.default_rng([seed, 41]).uniform(0.97, 1.03))

    def derivative(slip: float, turn: float, x: Array, u: Array) -> Array:
        speed = u[..., 0] * (1 - slip * u[..., 1] ** 2)
        return np.stack([speed * np.cos(x[..., 2]), speed * np.sin(x[..., 2]), turn * u[..., 1]], axis=-1)

    return experiment(
        "gravel-rover",
        "m",
        space=TaskSpace(y=(-1, 1, "m"), heading=(-1.2, 1.2, "rad"), goal_x=(5, 7, "m"), goal_y=(-1.5, 1.5, "m")),
        task=lambda p: Task([0.0, p.y, p.heading], goal=[p.goal_x, p.goal_y, 0.0], horizon=horizon, dt=dt),
        system=Noisy(systems.rk4(partial(derivative, 0.3, 0.9), dt), deviation, seed),
        model=simulated(partial(derivative, 0.0, gain), dt).model,
        synthesizer=controllers.Policy(_aim),
        distance=distances.MeanDeviation(components=(0, 1)),
    )


def _aim(t: int, x: Array, task: Task) -> Array:
    gap = task.goal[..., :2] - x[..., :2]
    far = np.sqrt((gap**2).sum(axis=-1) + 0.01)
    course = (gap[..., 1] * np.cos(x[..., 2]) - gap[..., 0] * np.sin(x[..., 2])) / far
    return np.stack([0.8 * np.tanh(far / 0.6), 1.4 * np.tanh(1.5 * course)], axis=-1)


def windy_vane(seed: int, deviation: tuple[float, ...] = (0.0, 0.12)) -> Experiment:
    """Return a vane in turbulent wind, the noise of which is not declared; M is linear, from its data. 3-D.

    The noise changes 92 % of the tasks, and the largest distance among them 1.4 times. It hardly changes the largest
    mean distance, because M errs more.
    """
    dt, horizon = 0.05, 40

    def derivative(x: Array, u: Array) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        return np.stack([rate, u[..., 0] - 5.0 * np.sin(2 * angle) - 0.8 * rate], axis=-1)

    system = Noisy(systems.rk4(derivative, dt), deviation, seed)
    return experiment(
        "windy-vane",
        "rad",
        space=TaskSpace(start=(-0.8, 0.8, "rad"), rate=(-1, 1, "rad/s"), goal=(-0.8, 0.8, "rad")),
        task=lambda p: Task([p.start, p.rate], goal=[p.goal, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [-0.3, -0.5], [0.3, 0.5], [2.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 1.0], [0.03]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


MISLEADING = (
    Entry("crane", "hidden", crane, True, partial(crane, payload=0.0), seeds=5),
    Entry("backlash", "hidden", backlash, True, partial(backlash, play=0.0)),
    Entry("oblique-wall", "contact", oblique_wall, True, partial(oblique_wall, stiffness=0.0), seeds=5),
    Entry("dry-sled", "stick-slip", dry_sled, True, partial(dry_sled, grip=0.0), seeds=5),
    Entry("full-wheel", "saturation", full_wheel, True, partial(full_wheel, limit=np.inf)),
    Entry("icy-corner", "switch", icy_corner, True, partial(icy_corner, hold=1.0), seeds=5),
    Entry("over-the-hill", "cliff", over_the_hill, True, partial(over_the_hill, height=1.0)),
    Entry(
        "gravel-rover",
        "noise",
        gravel_rover,
        without=partial(gravel_rover, deviation=(0.0,) * 3),
        noise=ROVER_NOISE,
        seeds=5,
    ),
    Entry("windy-vane", "noise", windy_vane, True, partial(windy_vane, deviation=(0.0, 0.0)), seeds=5),
)
