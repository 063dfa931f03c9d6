"""A wind turbine of 5 MW under gusts: the benchmark WT of the ARCH competition.

Source: Schuler, Adegas and Anta, *Hybrid Modelling of a Wind Turbine*, ARCH 2016, with the parameters and polynomials
of the power and thrust coefficients of its simplified model. The turbine is that of Jonkman, Butterfield, Musial and
Scott, *Definition of a 5-MW Reference Wind Turbine for Offshore System Development*, NREL/TP-500-38060, 2009. Rotor:
``J dw/dt = M_a - M_g / n``; tower top: ``m x'' + c x' + k x = F_a``; pitch actuator of second order.

Differences from the source: the wind over the rotor follows the task's wind with a lag of 1 s, which makes it a state;
rate limits and the filters of the measurements are left out; the anti-windup of the integral is a limit of it; the
generator's inertia counts with the square of the gear ratio. Below the rated speed there is one region of the torque,
quadratic in the speed, instead of three.
"""

from __future__ import annotations

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, record, simulated

DT, HORIZON = 0.25, 100
DENSITY, ROTOR, GEARBOX, RATED_SPEED, RATED_POWER = 1.225, 63.0, 97.0, 12.1 * 2 * np.pi / 60, 5296610.0
INERTIA = 115926.0 + 3 * 11776047.0 + 534.116 * GEARBOX**2
TOWER_MASS, TOWER_FREQUENCY, TOWER_DAMPING = 0.25 * 522617 + 240000 + 56780 + 3 * 17740, 0.31994, 0.01
PITCH_FREQUENCY, PITCH_DAMPING = 2 * np.pi, 0.7
GAIN, INTEGRAL_GAIN, SCHEDULE = 0.01882681, 0.008068634, 0.1099965
"""kP, kI and the pitch angle at which the gains are halved, rad."""
TORQUE_GAIN, TORQUE_LIMIT = 2.332287, 47402.91
"""Of the generator below the rated speed, Nm s^2, and at most, Nm."""


def power_coefficient(ratio: Array, pitch: Array) -> Array:
    """Return cP of the tip speed ratio and the pitch angle in rad (the polynomial of the source)."""
    return np.asarray(
        -0.000464550681271132 * ratio**3
        - 0.0747804872950038 * ratio**2 * pitch
        - 0.00245817585906700 * ratio**2
        - 0.372740535667247 * ratio * pitch**2
        + 0.0711147525908799 * ratio * pitch
        + 0.175932463831508 * ratio
        + 3.89808785329087 * pitch**3
        - 3.51436345740801 * pitch**2
        + 1.59939029665458 * pitch
        - 0.404129012120541
    )


def thrust_coefficient(ratio: Array, pitch: Array) -> Array:
    """Return cT of the tip speed ratio and the pitch angle in rad (the polynomial of the source)."""
    return np.asarray(
        0.00168223358976263 * ratio**3
        - 0.00515118049598468 * ratio**2 * pitch
        - 0.0472197248103825 * ratio**2
        + 1.16475825684817 * ratio * pitch**2
        - 1.52576164855595 * ratio * pitch
        + 0.553206918519747 * ratio
        + 6.91427835250700 * pitch**3
        - 10.9675429628383 * pitch**2
        + 6.00063627824827 * pitch
        - 0.980172788618940
    )


def derivative(x: Array, u: Array) -> Array:
    """Return the derivative of the state.

    Args:
        x: rotor speed (rad/s), displacement (m) and speed (m/s) of the tower top, pitch angle (rad) and its rate,
            integral of the speed error in the pitch control (rad), wind over the rotor (m/s).
        u: pitch demand (rad), torque of the generator (kNm), wind of the task (m/s).
    """
    speed, top, rate, pitch, turn, integral, wind = (x[..., i] for i in range(7))
    relative = np.maximum(wind - rate, 3.0)
    ratio = np.clip(speed * ROTOR / relative, 1.0, 14.0)
    pressed, angle = 0.5 * DENSITY * np.pi * ROTOR**2 * relative**2, np.clip(pitch, 0.0, 0.5)
    torque = power_coefficient(ratio, angle) * pressed * ROTOR / ratio
    push = thrust_coefficient(ratio, angle) * pressed
    swing = 2 * np.pi * TOWER_FREQUENCY
    error = GEARBOX * (speed - RATED_SPEED)
    held = ((integral <= 0) & (error < 0)) | ((integral >= 1) & (error > 0))
    return np.stack(
        [
            (torque - GEARBOX * np.clip(1e3 * u[..., 1], 0, TORQUE_LIMIT)) / INERTIA,
            rate,
            push / TOWER_MASS - 2 * TOWER_DAMPING * swing * rate - swing**2 * top,
            turn,
            PITCH_FREQUENCY**2 * (np.clip(u[..., 0], 0, np.pi / 2) - pitch)
            - 2 * PITCH_DAMPING * PITCH_FREQUENCY * turn,
            np.where(held, 0.0, INTEGRAL_GAIN * error),
            u[..., 2] - wind,
        ],
        axis=-1,
    )


def control(t: int, x: Array, task: Task) -> Array:
    """Return the demands of the published control: gain-scheduled pitch, and torque by region; and the wind."""
    generator = GEARBOX * x[..., 0]
    demand = (GAIN * (generator - GEARBOX * RATED_SPEED) + x[..., 5]) / (1 + np.maximum(x[..., 3], 0) / SCHEDULE)
    rated = (generator >= GEARBOX * RATED_SPEED) | (demand >= np.deg2rad(1.0))
    torque = np.where(rated, RATED_POWER / np.maximum(generator, 50.0), TORQUE_GAIN * generator**2)
    wind = np.broadcast_to(task.reference[..., t, 6], generator.shape)
    return np.stack([np.clip(demand, 0, np.pi / 2), np.clip(torque, 0, TORQUE_LIMIT) / 1e3, wind], axis=-1)


def steady_pitch(wind: Array) -> Array:
    """Return the published steady pitch angle in rad, NREL/TP-500-38060, table 7-1."""
    angles = np.deg2rad([0.0, 3.83, 6.60, 8.70, 10.45, 12.06, 13.54, 14.92, 16.23, 17.47, 18.70, 19.94, 21.18])
    return np.interp(wind, np.array([11.4, *range(12, 24)]), angles)


def blow(p: Parameters) -> Task:
    """Return the task: a mean wind that changes, and a gust like a Mexican hat (IEC 61400-1)."""
    time = np.arange(HORIZON + 1) * DT
    wind, change, gust, moment, length = (
        np.asarray(part)[..., None] for part in (p.wind, p.change, p.gust, p.moment, p.length)
    )
    share = (time - moment) / length
    hat = np.where(np.abs(share) < 0.5, np.sin(3 * np.pi * (share + 0.5)) * (1 - np.cos(2 * np.pi * (share + 0.5))), 0)
    blown = wind + change / (1 + np.exp(-(time - 10.0) / 1.5)) - 0.37 * gust * hat
    still = np.zeros_like(blown)
    pitch = steady_pitch(p.wind)
    first = [RATED_SPEED + 0 * p.wind, 0.3, 0.0, pitch, 0.0, pitch * (1 + pitch / SCHEDULE), p.wind]
    reference = np.stack([still + RATED_SPEED, still, still, still, still, still, blown], axis=-1)
    return Task(first, reference=reference, horizon=HORIZON, dt=DT)


def make(seed: int) -> Experiment:
    """Return the turbine under a changing wind with a gust; M is a Gaussian process, from moderate wind. 5-D."""
    system = simulated(derivative, DT, substeps=2)
    low, high = [1.15, 0.2, -0.1, 0.05, -0.02, 0.1, 12.5], [1.4, 0.45, 0.1, 0.25, 0.02, 0.5, 17.0]
    data = record(system, low, high, [0.08, 4.0, 2.0], DT, seed, rollouts=30, steps=8, around=[0.15, 42.0, 15.0])
    return experiment(
        "wind-turbine",
        "rad/s",
        space=TaskSpace(
            wind=(12, 18, "m/s"),
            change=(-5, 5, "m/s"),
            gust=(0, 6, "m/s"),
            moment=(6, 18, "s"),
            length=(6, 14, "s"),
        ),
        task=blow,
        system=system,
        model=models.GaussianProcessModel.fit(data, points=60, seed=seed),
        synthesizer=controllers.Policy(control),
        distance=distances.MeanDeviation(components=(0,)),
    )
