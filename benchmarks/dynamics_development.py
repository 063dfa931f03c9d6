"""The systems on which a certificate from learned dynamics is developed: thresholds may be chosen on these.

Nothing may be chosen on those of ``dynamics_reporting.py``. The systems of ``misleading.py`` and the paper's cases are
development systems too. Those of the systems here that mislead are in ``dynamics_development_misleading.py``.
"""

from __future__ import annotations

from functools import partial

import numpy as np

import misleading
import study_auto
from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_development_misleading import MISLEADING
from dynamics_systems import Entry, experiment, listed, path, record, simulated

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


# The lists

PAPER = listed(
    *(
        Entry(case, "smooth", partial(study_auto.experiment, case))
        for case in (
            *("pendulum", "dubins", "dubins-basin", "dubins-heavy-tail"),
            *("linear-1", "linear-2", "linear-5", "linear-10"),
            *("arm-linear", "arm-gp", "arm-fnn"),
        )
    )
)
"""The paper's cases by the names of ``study_auto.py``, whose function ``truth`` has their maxima; linear-n is 2 n-D."""

DEVELOPMENT = listed(
    Entry("hanging-pendulum", "smooth", hanging_pendulum),
    Entry("two-tanks", "smooth", two_tanks),
    Entry("cart-pole", "smooth", cart_pole, seeds=5),
    Entry("hard-springs", "smooth", hard_springs, seeds=5),
    Entry("trailer", "smooth", trailer),
    Entry("wavy-field", "prior", wavy_field),
    *MISLEADING,
    Entry("hidden-heat", "hidden", misleading.hidden_heat, True, seeds=5),
    Entry("hidden-load", "hidden", misleading.hidden_load, True, seeds=5),
    Entry("corner-stop", "contact", misleading.corner_stop, True, seeds=5),
)
