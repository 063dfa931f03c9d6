"""The paper's Dubins car (Sec. VI-A): a linear model learned from it, and LQR that follows sums of ten sine waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval import (
    Array,
    Experiment,
    Parameters,
    Task,
    TaskSpace,
    Trajectory,
    Transitions,
    Validation,
    cached_truth,
    controllers,
    distances,
    models,
    search_truth,
    systems,
)
from ctxval.errors import UnknownNameError

WAVES = 10  #: sine components of the reference, as in the paper


def root_mean_square(model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
    """Return ``||xi_S - xi_M||_2 / sqrt(H)``, the root mean square over time of the gap between the states.

    It is ``sqrt(H)`` = 10 times the printed formula, so the worst task and the choices of a search are the same.
    """
    whole = distances.WholeTrajectory(norm=2)(model_trajectory, system_trajectory, task)
    return np.asarray(whole / np.sqrt(task.horizon))


DISTANCES: dict[str, distances.Distance] = {
    "printed": distances.WholeTrajectory(norm=2, per_step=True, weights=(1, 1, 1)),  # the paper adds m and rad
    "root-mean-square": root_mean_square,
    "mean-deviation": distances.MeanDeviation(norm=2, components=(0, 1)),
}
"""The formula as printed, ``||xi_S - xi_M||_2 / H``, and two readings of the paper's text, which calls it the "average
deviation in metres". The first two distances count a radian of heading as a metre; the last one is the mean over time
of the distance between the positions alone."""


@dataclass(frozen=True)
class Dubins:
    """A car that cannot slip sideways: ``y' = v cos phi``, ``z' = v sin phi``, ``phi' = w`` (eq. 12)."""

    def derivative(self, x: Array, u: Array) -> Array:
        """Return (y', z', phi') in m/s and rad/s for states (y, z, phi) ``(..., 3)`` and inputs (v, w) ``(..., 2)``."""
        heading, speed, turn_rate = x[..., 2], u[..., 0], u[..., 1]
        rates = speed * np.cos(heading), speed * np.sin(heading), turn_rate
        return np.stack(np.broadcast_arrays(*rates), axis=-1)


@dataclass(frozen=True)
class Settings:
    """Every free parameter of the case, with the reason for its value; the defaults are the variant ``paper``.

    The paper gives the horizon, the start and the task space. It reports a largest average deviation of 3.5 m, found
    in 100 executions, and that 500 random tasks stay below 2 to 3 m. With the root mean square as the average, this
    case agrees in the median over seeds (docs/reproduction.md). The printed formula gives a tenth of these values. The
    mean deviation of the position is smaller: 3.5 m, several times the mean height of the waves, would need a closed
    loop on S that is nearly unstable.
    """

    horizon: int = 100  #: steps, the paper's H
    #: s; with it the ten waves have 0.1 to 1 Hz. From 0.2 s on, the closed loop on S begins to lose stability.
    dt: float = 0.1
    #: weight of the heading's deviation, 1/rad^2, if a position weighs 1/m^2. It is small, because the reference
    #: heading of 0 is not that of the waves; with 1 the car hardly turns, and no task is much worse than most others.
    heading_weight: float = 0.1
    #: s^2/m^2 and s^2/rad^2. At 0.05 and below, the closed loop on S loses stability in some tasks.
    input_weight: float = 0.1
    #: recorded steps; with so many the models of all seeds are similar, and their closed loops on S stable
    samples: int = 1000
    #: rad; recorded headings are uniform within plus or minus a quarter turn. Over a full turn the effect of the speed
    #: cancels, so that in the model no input moves y.
    heading: float = np.pi / 2
    #: m/s; recorded speeds are uniform from 0 to this. When the model steers z, it takes the mean of the recorded
    #: speeds as the speed of the car: the lower this mean, the harder it turns. This sets the root mean square d*: 2.9
    #: m for 2, 3.6 m for 1.75, 5 m for 1.5, 8 m for 1.25.
    speed: float = 1.75
    #: rad/s; recorded turn rates are uniform within plus or minus this. The heading is linear in the turn rate, so any
    #: value would do.
    turn_rate: float = 1.0
    #: m; recorded positions are uniform within plus or minus this. Only the model's errors depend on them.
    position: float = 1.0
    #: m/s and rad/s; the largest input. Without it a loop that loses stability grows until rounding errors dominate.
    limit: float = np.inf
    first_seed: int = 0  #: added to the seed of the data
    distance: str = "printed"  #: a name of ``DISTANCES``
    threshold: float = 0.25  #: m; the threshold for that distance, between the largest distance of random tasks and d*


VARIANTS: dict[str, Settings] = {
    "paper": Settings(),
    # With fewer data the models differ more. For some seeds, such as the first one here, the distance has a wide local
    # maximum at the end point 0, at which half of all climbs end.
    "basin": Settings(samples=400, speed=2.0, first_seed=25, threshold=0.2),
    # Inputs have a small weight: in a few corners of the task space the closed loop on S loses stability, and the car
    # turns at its limits. Data of small headings and a larger weight of the heading keep these corners few.
    "heavy-tail": Settings(
        heading_weight=0.3, input_weight=0.01, samples=2000, heading=np.pi / 4, speed=2.0, limit=10.0, threshold=0.2
    ),
}
"""``paper`` resembles the results of the paper; the other two variants are hard for a search and for a surrogate."""


def record(car: Dubins, settings: Settings, seed: int) -> Transitions:
    """Return single steps of the car from seeded random states under seeded random inputs."""
    rng = np.random.default_rng(seed)
    far = np.array([settings.position, settings.position, settings.heading])
    x = rng.uniform(-far, far, (settings.samples, 3))
    u = rng.uniform([0.0, -settings.turn_rate], [settings.speed, settings.turn_rate], (settings.samples, 2))
    return Transitions(x, u, systems.rk4(car.derivative, settings.dt)(x, u))


def reference(end: Array, amplitudes: Array, horizon: int) -> Array:
    """Return the states to follow, ``(..., H + 1, 3)``, for ends a_0 ``(...)`` and amplitudes a_j ``(..., 10)`` in m.

    In the paper ``z(t) = sum_j a_j sin(2 pi j y(t) / a_0)`` with ``y(t) = t a_0 / H``; a_0 cancels, so it may be 0.
    """
    share = np.arange(horizon + 1) / horizon
    waves = np.sin(2 * np.pi * np.arange(1, WAVES + 1)[:, None] * share)
    y, z = end[..., None] * share, amplitudes @ waves
    return np.stack([y, z, np.zeros_like(y)], axis=-1)


def experiment(
    seed: int = 0, variant: str = "paper", distance: str | None = None, settings: Settings | None = None
) -> Experiment:
    """Return the case; the seed draws the data that the linear model is learned from."""
    if settings is None:
        if variant not in VARIANTS:
            raise UnknownNameError.among("variant of the case 'dubins'", variant, VARIANTS)
        settings = VARIANTS[variant]
    name = settings.distance if distance is None else distance
    if name not in DISTANCES:
        raise UnknownNameError.among("distance of the case 'dubins'", name, DISTANCES)
    validation = tracking(seed, settings, DISTANCES[name])
    return Experiment(
        "dubins",
        validation,
        budget=100,
        threshold=settings.threshold if name == settings.distance else None,
        truth=lambda: cached_truth(validation, search_truth),
        units="m",
        states=("y [m]", "z [m]", "heading [rad]"),
        inputs=("speed [m/s]", "turn rate [rad/s]"),
    )


def tracking(seed: int, settings: Settings, distance: distances.Distance) -> Validation:
    """Return the validation of a linear model of the car on tasks that follow ten waves."""
    car = Dubins()

    def follow(p: Parameters) -> Task:
        states = reference(p.end, p.amplitudes, settings.horizon)
        return Task([0.0, 0.0, 0.0], reference=states, horizon=settings.horizon, dt=settings.dt)

    return Validation(
        space=TaskSpace(end=(0.0, 2.0, "m"), amplitudes=(np.zeros(WAVES), np.ones(WAVES), "m")),
        task=follow,
        system=systems.Simulated(systems.rk4(car.derivative, settings.dt), vectorized=True),
        model=models.Linear.fit(record(car, settings, settings.first_seed + seed)),
        synthesizer=controllers.LQR(
            [1.0, 1.0, settings.heading_weight],
            [settings.input_weight] * 2,
            limits=None if np.isinf(settings.limit) else settings.limit,
        ),
        distance=distance,
    )
