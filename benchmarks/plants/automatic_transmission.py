"""An automatic transmission with four gears: the benchmark AT of the ARCH competition.

Sources: Hoxha, Abbas and Fainekos, *Benchmarks for Temporal Logic Requirements for Automotive Systems*, ARCH 2014,
section 2. The equations and all tables are those of the model that it takes over, *Modeling an Automatic Transmission
Controller* (The MathWorks): the engine ``I_ei dN_e/dt = T_e - T_i``, the torque converter
``T_i = (N_e / K)^2, T_t = R_TQ T_i`` with K and R_TQ functions of the speed ratio, the gears, and the vehicle
``I_v dN_w/dt = R_fd T_out - T_load``.

Differences from the source: the shift logic acts at once, every 0.04 s; its wait of 0.08 s is left out, because it
would be a state that is not recorded. The sign of the road load is a steep tanh. K is rounded to two decimals. A cruise
control follows a speed, where the competition searches over pedals.
"""

from __future__ import annotations

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, Transitions, controllers, distances, models, systems
from ctxval._util.arrays import Array
from dynamics_systems import experiment
from plants.tables import bilinear

TICK = 0.04
"""s, of the shift logic and of the integration."""
DT, HORIZON = 0.2, 60

ENGINE_INERTIA, VEHICLE_INERTIA = 0.0219914882835559, 12.09414785731247
FINAL_DRIVE, FRICTION, DRAG, WHEEL_RADIUS = 3.23, 40.0, 0.02, 1.0
MPH = 2 * np.pi * WHEEL_RADIUS * 60 / 5280
"""mph of a wheel that turns once in a minute; the radius is in feet."""
LIMITS = (600.0, 6000.0)
"""rpm of the engine."""
RATIOS = np.array([2.393, 1.450, 1.000, 0.677])

THROTTLES = np.array([0.0, 20, 30, 40, 50, 60, 70, 80, 90, 100])
ENGINE_SPEEDS = np.arange(800.0, 4801.0, 400.0)
ENGINE_TORQUE = np.array(
    [
        [-40, -44, -49, -53, -57, -61, -65, -70, -74, -78, -82],
        [215, 117, 85, 66, 44, 29, 10, -2, -13, -22, -32],
        [245, 208, 178, 148, 122, 104, 85, 66, 48, 33, 18],
        [264, 260, 241, 219, 193, 167, 152, 133, 119, 96, 85],
        [264, 279, 282, 275, 260, 238, 223, 208, 189, 171, 152],
        [267, 290, 293, 297, 290, 275, 260, 256, 234, 212, 193],
        [267, 297, 305, 305, 305, 301, 293, 282, 267, 249, 226],
        [267, 301, 308, 312, 319, 323, 319, 316, 297, 279, 253],
        [267, 301, 312, 319, 327, 327, 327, 327, 312, 293, 267],
        [267, 301, 312, 319, 327, 334, 334, 334, 319, 305, 275],
    ],
    dtype=float,
)
"""ft lb, over throttle (%) and engine speed (rpm)."""

SPEED_RATIOS = np.array([*np.arange(0, 0.75, 0.1), *np.arange(0.8, 0.905, 0.01), 0.92, 0.94])
CAPACITIES = np.array(
    [137.47, 137.07, 135.86, 135.66, 137.57, 140.37, 145.27, 152.87, 162.98, 164.28, 166.18, 167.98, 170.08, 172.78,
     175.38, 179.59, 183.59, 189.89, 197.69, 215.90, 244.52]
)  # fmt: skip
"""K, rpm / (ft lb)^0.5, over the speed ratio of turbine and engine."""
TORQUE_RATIOS = np.array(
    [2.232, 2.075, 1.975, 1.846, 1.720, 1.564, 1.409, 1.254, 1.096, 1.080, 1.061, 1.043, 1.028, 1.012, 1.002, 1.002,
     1.001, 0.998, 0.999, 1.001, 1.002]
)  # fmt: skip

UP_THROTTLES = np.array([0.0, 25, 35, 50, 90, 100])
UP_SPEEDS = np.array([[10.0, 10, 15, 23, 40, 40], [30, 30, 30, 41, 70, 70], [50, 50, 50, 60, 100, 100], [1e6] * 6])
"""mph above which a gear is left upwards, for each gear, over the throttle."""
DOWN_THROTTLES = np.array([0.0, 5, 40, 50, 90, 100])
DOWN_SPEEDS = np.array([[0.0] * 6, [5, 5, 5, 5, 30, 30], [20, 20, 25, 30, 50, 50], [35, 35, 40, 50, 80, 80]])
"""mph below which a gear is left downwards."""

GEARS = np.arange(4.0)


def derivative(x: Array, u: Array) -> Array:
    """Return the derivative of speed (mph), engine speed (rpm) and gear; u is throttle (%) and brake (ft lb)."""
    speed, engine = x[..., 0], np.clip(x[..., 1], *LIMITS)
    ratio = RATIOS[_gear(x)]
    slip = ratio * FINAL_DRIVE * speed / MPH / engine
    impeller = (engine / np.interp(slip, SPEED_RATIOS, CAPACITIES)) ** 2
    output = np.interp(slip, SPEED_RATIOS, TORQUE_RATIOS) * impeller * ratio
    torque = bilinear(u[..., 0], engine, THROTTLES, ENGINE_SPEEDS, ENGINE_TORQUE)
    # tanh for the sign of the load, so that a vehicle at rest does not tremble.
    load = np.tanh(speed / 0.1) * (FRICTION + DRAG * speed**2 + u[..., 1])
    moved = MPH * (FINAL_DRIVE * output - load) / VEHICLE_INERTIA
    return np.stack([moved, (torque - impeller) / ENGINE_INERTIA, np.zeros_like(moved)], axis=-1)


def _gear(x: Array) -> Array:
    """Return the index of the gear, 0 to 3."""
    return np.clip(np.round(x[..., 2]) - 1, 0, 3).astype(int)


def shifted(x: Array, throttle: Array) -> Array:
    """Return the gear, 1 to 4, in which the shift logic leaves a state."""
    gear = _gear(x)
    up = bilinear(gear, throttle, GEARS, UP_THROTTLES, UP_SPEEDS)
    down = bilinear(gear, throttle, GEARS, DOWN_THROTTLES, DOWN_SPEEDS)
    return np.asarray(np.clip(1.0 + gear + (x[..., 0] > up) - (x[..., 0] < down), 1, 4))


_integrated = systems.rk4(derivative, TICK)


def step(x: Array, u: Array) -> Array:
    """Return the state after a control step, in which the shift logic acts in every tick."""
    u = np.clip(u, 0.0, [100.0, 325.0])
    for _ in range(round(DT / TICK)):
        x = _integrated(x, u)
        x = np.stack([x[..., 0], np.clip(x[..., 1], *LIMITS), shifted(x, u[..., 0])], axis=-1)
    return x


def pedals(t: int, x: Array, task: Task) -> Array:
    """Return throttle and brake of a cruise control that follows the reference speed."""
    target = task.reference[..., t, 0]
    gap = target - x[..., 0]
    return np.stack([np.clip(0.25 * target + 5.0 * gap, 0, 100), np.clip(-40.0 * (gap + 2.0), 0, 325)], axis=-1)


def drive(p: Parameters) -> Task:
    """Return the task from standstill: to a speed, to another one, and a wave on it."""
    time = np.arange(HORIZON + 1) * DT
    first, second, change = (np.asarray(part)[..., None] for part in (p.first, p.second, p.change))
    late = 1 / (1 + np.exp(-(time - change) / 0.5))
    wave = np.asarray(p.amplitude)[..., None] * np.sin(2 * np.pi * np.asarray(p.frequency)[..., None] * time)
    speed = first * np.tanh(time / 3.0) + late * (second - first) + late * wave
    still = np.zeros_like(speed)
    reference = np.stack([np.maximum(speed, 0.0), 1000.0 + still, 1.0 + still], axis=-1)
    return Task([0.0 * p.first, 1000.0, 1.0], reference=reference, horizon=HORIZON, dt=DT)


def recorded(system: systems.System, seed: int) -> Transitions:
    """Return drives of a careful driver, with a seeded disturbance of the throttle."""
    rng = np.random.default_rng([seed, 23])
    count = 12
    space = TaskSpace(first=(10, 45), second=(5, 45), change=(3, 8), amplitude=(0, 4), frequency=(0.05, 0.2))
    task = drive(space.parameters(space.iid(count, rng)))
    nudge = rng.uniform(-8, 8, (HORIZON, count, 2)) * [1.0, 0.0]
    driven = system.execute(lambda t, x: np.clip(pedals(t, x, task) + nudge[t], 0, [100, 325]), task)
    return driven.transitions()


def make(seed: int) -> Experiment:
    """Return a cruise control on the transmission; M is a network learned from careful drives. 5-D."""
    system = systems.Simulated(step, vectorized=True)
    return experiment(
        "automatic-transmission",
        "mph",
        space=TaskSpace(
            first=(10, 60, "mph"),
            second=(0, 70, "mph"),
            change=(3, 9, "s"),
            amplitude=(0, 10, "mph"),
            frequency=(0.05, 0.3, "Hz"),
        ),
        task=drive,
        system=system,
        model=models.FeedforwardReLU.fit(recorded(system, seed), (12, 12), seed=seed, restarts=1, iterations=400),
        synthesizer=controllers.Policy(pedals),
        distance=distances.MeanDeviation(components=(0,)),
    )
