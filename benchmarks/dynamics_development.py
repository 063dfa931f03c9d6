"""The systems on which a certificate from learned dynamics is developed: thresholds may be chosen on these.

Nothing may be chosen on those of ``dynamics_reporting.py``. The systems of ``misleading.py`` and the paper's cases are
development systems too. Shares of tasks in docstrings are those of 20,000 random tasks in ``dynamics_check.py``: the
mechanism changes their distance by more than a quarter of the median distance without it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

import misleading
from ctxval import Experiment, Parameters, Task, TaskSpace, cases, controllers, distances, models, systems
from ctxval._util.arrays import Array
from dynamics_systems import (
    Entry,
    Noisy,
    PartlySeen,
    experiment,
    friction,
    listed,
    path,
    record,
    repeated,
    simulated,
)

# Smooth


def hanging_pendulum(seed: int) -> Experiment:
    """Return a hanging pendulum in oil; M is linear, from small swings. 2-D."""
    dt, horizon = 0.05, 40

    def derivative(x: Array, u: Array) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        return np.stack([rate, u[..., 0] - 6.0 * np.sin(angle) - 0.3 * rate * np.abs(rate)], axis=-1)

    system = simulated(derivative, dt)
    return experiment(
        "hanging-pendulum",
        "rad, rad/s",
        space=TaskSpace(start=(-1.5, 1.5, "rad"), goal=(-2, 2, "rad")),
        task=lambda p: Task([p.start, 0.0], goal=[p.goal, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [-0.4, -0.4], [0.4, 0.4], [2.0], dt, seed)),
        synthesizer=controllers.LQR([10.0, 1.0], [0.02]),
        distance=distances.FinalState(norm=2),
    )


def two_tanks(seed: int) -> Experiment:
    """Return two tanks one above the other, whose outflow goes by the root of the level; M is linear. 3-D."""
    dt, horizon, holes = 2.0, 40, (0.08, 0.06)

    def derivative(x: Array, u: Array) -> Array:
        upper, lower = (holes[i] * np.sqrt(np.maximum(x[..., i], 0) + 1e-3) for i in range(2))
        return np.stack([0.04 + u[..., 0] - upper, upper - lower], axis=-1)

    def fill(p: Parameters) -> Task:
        return Task([p.upper, p.lower], goal=[p.goal * (holes[1] / holes[0]) ** 2, p.goal], horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    return experiment(
        "two-tanks",
        "m",
        space=TaskSpace(upper=(0.1, 1.2, "m"), lower=(0.1, 1.2, "m"), goal=(0.2, 1.2, "m")),
        task=fill,
        system=system,
        model=models.Linear.fit(record(system, [0.25, 0.4], [0.4, 0.6], [0.01], dt, seed)),
        synthesizer=controllers.LQR([0.1, 1.0], [20.0]),
        distance=distances.MeanDeviation(),
    )


def cart_pole(seed: int) -> Experiment:
    """Return a pole that is balanced on a cart moving to a goal; M is linear, from small angles. 4-D."""
    dt, horizon = 0.04, 50

    def derivative(x: Array, u: Array) -> Array:
        angle, speed, rate = x[..., 1], x[..., 2], x[..., 3]
        sine, cosine = np.sin(angle), np.cos(angle)
        pull = (u[..., 0] + 0.1 * rate**2 * sine) / 1.2
        turned = (9.81 * sine - cosine * pull) / (0.5 * (4 / 3 - 0.2 * cosine**2 / 1.2))
        return np.stack([speed, rate, pull - 0.1 * turned * cosine / 1.2, turned], axis=-1)

    system = simulated(derivative, dt)
    return experiment(
        "cart-pole",
        "m, rad, m/s, rad/s",
        space=TaskSpace(
            position=(-1, 1, "m"), angle=(-0.35, 0.35, "rad"), rate=(-0.6, 0.6, "rad/s"), goal=(-1, 1, "m")
        ),
        task=lambda p: Task([p.position, p.angle, 0.0, p.rate], goal=[p.goal, 0.0, 0.0, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.1, -0.3, -0.1], [1, 0.1, 0.3, 0.1], [2.0], dt, seed, steps=8)),
        synthesizer=controllers.LQR([3.0, 1.0, 0.3, 0.3], [0.05]),
        distance=distances.WholeTrajectory(),
    )


def hard_springs(seed: int) -> Experiment:
    """Return two carts between springs that harden, the first one pushed; M is linear. 6-D."""
    dt, horizon = 0.1, 50

    def derivative(x: Array, u: Array) -> Array:
        first, second, gap = x[..., 0], x[..., 1], x[..., 1] - x[..., 0]
        spring = 4.0 * gap + 3.0 * gap**3
        pushed = u[..., 0] + spring - first - 0.8 * first**3 - 0.4 * x[..., 2]
        return np.stack([x[..., 2], x[..., 3], pushed, -spring - second - 0.4 * x[..., 3]], axis=-1)

    def shake(p: Parameters) -> Task:
        way, speed = path(horizon, dt, p.first, p.goal, p.amplitude, p.frequency)
        start = [p.first, p.second, p.speed, np.zeros_like(p.speed)]
        return Task(start, reference=np.stack([way, way, speed, speed], axis=-1), horizon=horizon, dt=dt)

    system = simulated(derivative, dt)
    return experiment(
        "hard-springs",
        "m, m/s",
        space=TaskSpace(
            first=(-0.6, 0.6, "m"),
            second=(-0.6, 0.6, "m"),
            speed=(-0.6, 0.6, "m/s"),
            goal=(-0.8, 0.8, "m"),
            amplitude=(0, 0.3, "m"),
            frequency=(0.05, 0.3, "Hz"),
        ),
        task=shake,
        system=system,
        model=models.Linear.fit(record(system, [-0.3] * 4, [0.3] * 4, [0.5], dt, seed)),
        synthesizer=controllers.LQR([5.0, 5.0, 0.5, 0.5], [0.2]),
        distance=distances.WholeTrajectory(norm=2, per_step=True),
    )


def trailer(seed: int) -> Experiment:
    """Return a steered trailer, of which M is a small Gaussian process of a few runs. 4-D."""
    dt, horizon = 0.2, 30

    def derivative(x: Array, u: Array) -> Array:
        heading, fold = x[..., 1], x[..., 2]
        turn = 0.8 * np.tan(np.clip(u[..., 0], -1.2, 1.2))
        return np.stack([np.sin(heading), turn, -turn - 1.25 * np.sin(fold)], axis=-1)

    system = simulated(derivative, dt)
    data = record(system, [-1, -0.8, -0.5], [1, 0.8, 0.5], [0.5], dt, seed, rollouts=20, steps=10)
    return experiment(
        "trailer",
        "m, rad",
        space=TaskSpace(
            offset=(-1.2, 1.2, "m"), heading=(-0.8, 0.8, "rad"), fold=(-0.6, 0.6, "rad"), lane=(-0.6, 0.6, "m")
        ),
        task=lambda p: Task([p.offset, p.heading, p.fold], goal=[p.lane, 0.0, 0.0], horizon=horizon, dt=dt),
        system=system,
        model=models.GaussianProcessModel.fit(data, points=40, seed=seed),
        synthesizer=controllers.Policy(_follow_lane, limits=0.6),
        distance=distances.MeanDeviation(norm=2),
    )


def _follow_lane(t: int, x: Array, task: Task) -> Array:
    return np.asarray((0.6 * (task.goal[..., 0] - x[..., 0]) - 1.2 * x[..., 1])[..., None])


# Drawn from a prior


def wavy_field(seed: int) -> Experiment:
    """Return a body in a field of a few random waves of state and input; another one for each seed. 3-D."""
    dt, horizon = 0.1, 30
    rng = np.random.default_rng([seed, 101])
    waves = rng.normal(0, 1.0, (4, 3)) / rng.uniform(0.7, 2.0, 3)
    phases, sizes = rng.uniform(0, 2 * np.pi, 4), rng.normal(0, 0.25, 4)

    def derivative(x: Array, u: Array) -> Array:
        z = np.concatenate([x, u], axis=-1)
        return np.stack([x[..., 1], u[..., 0] - 0.5 * x[..., 1] + np.sin(z @ waves.T + phases) @ sizes], axis=-1)

    A, B = np.array([[1, dt], [0, 1 - 0.5 * dt]]), np.array([[0.5 * dt**2], [dt]])
    return experiment(
        "wavy-field",
        "m, m/s",
        space=TaskSpace(start=(-1, 1, "m"), speed=(-1, 1, "m/s"), goal=(-1, 1, "m")),
        task=lambda p: Task([p.start, p.speed], goal=[p.goal, 0.0], horizon=horizon, dt=dt),
        system=simulated(derivative, dt),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([5.0, 1.0], [1.0]),
        distance=distances.FinalState(norm=2),
    )


# Misleading


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

    The gust changes 2 % of the tasks, and the largest distance 17 times.
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

    The limit changes 8 % of the tasks, and the largest distance 3 times.
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

    The post changes 0.4 % of the tasks, and the largest distance twice.
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


def paper(name: str, **options: object) -> Entry:
    """Return a case of the paper."""
    label = "-".join([name, *(str(2 * v if k == "dim" else v) for k, v in options.items())])  # type: ignore[operator]
    return Entry(label, "smooth", lambda seed: cases.by_name(name, seed, **options))


PAPER = listed(
    paper("pendulum"),
    paper("dubins"),
    paper("dubins", variant="basin"),
    paper("dubins", variant="heavy-tail"),
    *(paper("linear", dim=n) for n in (1, 2, 5, 10)),
    *(paper("arm", model=model) for model in ("linear", "gp", "fnn")),
)
"""The paper's cases; their truths are those of ``study_auto.py``."""

DEVELOPMENT = listed(
    Entry("hanging-pendulum", "smooth", hanging_pendulum),
    Entry("two-tanks", "smooth", two_tanks),
    Entry("cart-pole", "smooth", cart_pole, seeds=5),
    Entry("hard-springs", "smooth", hard_springs, seeds=5),
    Entry("trailer", "smooth", trailer),
    Entry("wavy-field", "prior", wavy_field),
    Entry("lagging-valve", "hidden", lagging_valve, True, partial(lagging_valve, lag=0.02), seeds=5),
    Entry("sticky-slide", "stick-slip", sticky_slide, True, partial(sticky_slide, dry=0.0, extra=0.0)),
    Entry("gust-zone", "switch", gust_zone, True, partial(gust_zone, push=0.0)),
    Entry("balance-at-limit", "cliff", balance_at_limit, True, partial(balance_at_limit, heavier=1.0)),
    Entry("weak-motor", "saturation", weak_motor, True, partial(weak_motor, limit=np.inf)),
    Entry("gate-at-post", "contact", gate_at_post, True, partial(gate_at_post, stiffness=0.0)),
    Entry(
        "noisy-oven", "noise", noisy_oven, without=partial(noisy_oven, deviation=(0.0, 0.0)), noise=OVEN_NOISE, seeds=5
    ),
    Entry("hidden-heat", "hidden", misleading.hidden_heat, True, seeds=5),
    Entry("hidden-load", "hidden", misleading.hidden_load, True, seeds=5),
    Entry("corner-stop", "contact", misleading.corner_stop, True, seeds=5),
)
