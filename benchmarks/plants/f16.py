"""The longitudinal motion of the F-16 that pulls up: a subset of the benchmark F16 of the ARCH competition.

Sources: Stevens and Lewis, *Aircraft Control and Simulation*, appendix A (aerodynamics from NASA TP-1538, engine,
atmosphere, equations of motion), and Heidlauf, Collins, Bolender and Bak, *Verification Challenges in F-16 Ground
Collision Avoidance and Other Automated Maneuvers*, ARCH 2018, which took them over.

The subset: wings are level and nothing moves sideways, so the states are speed (ft/s), angle of attack, pitch angle
(rad), pitch rate (rad/s), height (ft) and engine power (%); inputs are throttle (0 to 1) and elevator (degrees). The
roll to wings level, which comes before the pull-up of the ground collision avoidance, is left out, and an LQR on M
pulls up instead of the published one.
"""

from __future__ import annotations

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, Transitions, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, path, record, simulated
from plants.tables import bilinear, linear

DT, HORIZON = 0.1, 60
GRAVITY, AREA, CHORD = 32.17, 300.0, 11.32
INVERSE_MASS, INVERSE_INERTIA = 1.57e-3, 1.792e-5
"""1/slug, and c7, 1/(slug ft^2)."""
DEGREES = 180 / np.pi

ATTACK = np.arange(-10.0, 46.0, 5.0)
ELEVATOR = np.arange(-24.0, 25.0, 12.0)
DRAG = np.array(
    [
        [-0.099, -0.081, -0.081, -0.063, -0.025, 0.044, 0.097, 0.113, 0.145, 0.167, 0.174, 0.166],
        [-0.048, -0.038, -0.040, -0.021, 0.016, 0.083, 0.127, 0.137, 0.162, 0.177, 0.179, 0.167],
        [-0.022, -0.020, -0.021, -0.004, 0.032, 0.094, 0.128, 0.130, 0.154, 0.161, 0.155, 0.138],
        [-0.040, -0.038, -0.039, -0.025, 0.006, 0.062, 0.087, 0.085, 0.100, 0.110, 0.104, 0.091],
        [-0.083, -0.073, -0.076, -0.072, -0.046, 0.012, 0.024, 0.025, 0.043, 0.053, 0.047, 0.040],
    ]
)
"""Cx over elevator and angle of attack."""
PITCHING = np.array(
    [
        [0.205, 0.168, 0.186, 0.196, 0.213, 0.251, 0.245, 0.238, 0.252, 0.231, 0.198, 0.192],
        [0.081, 0.077, 0.107, 0.110, 0.110, 0.141, 0.127, 0.119, 0.133, 0.108, 0.081, 0.093],
        [-0.046, -0.020, -0.009, -0.005, -0.006, 0.010, 0.006, -0.001, 0.014, 0.000, -0.013, 0.032],
        [-0.174, -0.145, -0.121, -0.127, -0.129, -0.102, -0.097, -0.113, -0.087, -0.084, -0.069, -0.006],
        [-0.259, -0.202, -0.184, -0.193, -0.199, -0.150, -0.160, -0.167, -0.104, -0.076, -0.041, -0.005],
    ]
)
"""Cm over elevator and angle of attack."""
LIFT = np.array([0.770, 0.241, -0.100, -0.415, -0.731, -1.053, -1.355, -1.646, -1.917, -2.120, -2.248, -2.229])
"""Cz over the angle of attack."""
DAMPING = np.array(
    [
        [-0.267, -0.110, 0.308, 1.34, 2.08, 2.91, 2.76, 2.05, 1.50, 1.49, 1.83, 1.21],
        [-8.80, -25.8, -28.9, -31.4, -31.2, -30.7, -27.7, -28.2, -29.0, -29.8, -38.3, -35.3],
        [-7.21, -0.540, -5.23, -5.26, -6.11, -6.64, -5.69, -6.00, -6.20, -6.40, -6.60, -6.00],
    ]
).T
"""Cxq, Czq and Cmq over the angle of attack."""

HEIGHTS, MACH = np.arange(0.0, 50001.0, 10000.0), np.arange(0.0, 1.01, 0.2)
IDLE = np.array(
    [
        [1060, 670, 880, 1140, 1500, 1860],
        [635, 425, 690, 1010, 1330, 1700],
        [60, 25, 345, 755, 1130, 1525],
        [-1020, -170, -300, 350, 910, 1360],
        [-2700, -1900, -1300, -247, 600, 1100],
        [-3600, -1400, -595, -342, -200, 700],
    ],
    dtype=float,
)
MILITARY = np.array(
    [
        [12680, 9150, 6200, 3950, 2450, 1400],
        [12680, 9150, 6313, 4040, 2470, 1400],
        [12610, 9312, 6610, 4290, 2600, 1560],
        [12640, 9839, 7090, 4660, 2840, 1660],
        [12390, 10176, 7750, 5320, 3250, 1930],
        [11680, 9848, 8050, 6100, 3800, 2310],
    ],
    dtype=float,
)
MAXIMUM = np.array(
    [
        [20000, 15000, 10800, 7000, 4000, 2500],
        [21420, 15700, 11225, 7323, 4435, 2600],
        [22700, 16860, 12250, 8154, 5000, 2835],
        [24240, 18910, 13760, 9285, 5700, 3215],
        [26070, 21075, 15975, 11115, 6860, 3950],
        [28886, 23319, 18300, 13484, 8642, 5057],
    ],
    dtype=float,
)
"""Thrust in pounds over Mach number and height, of the three settings of the engine."""


def thrust(power: Array, height: Array, mach: Array) -> Array:
    """Return the thrust, pounds."""
    idle, military, most = (bilinear(mach, height, MACH, HEIGHTS, table) for table in (IDLE, MILITARY, MAXIMUM))
    return np.where(power < 50, idle + (military - idle) * power / 50, military + (most - military) * (power / 50 - 1))


def power_rate(power: Array, throttle: Array) -> Array:
    """Return the rate of the engine power, %/s, under a throttle between 0 and 1."""
    command = np.where(throttle <= 0.77, 64.94 * throttle, 217.38 * throttle - 117.38)
    target = np.where(command >= 50, np.where(power >= 50, command, 60.0), np.where(power >= 50, 40.0, command))
    gap = target - power
    slow = np.where(gap <= 25, 1.0, np.where(gap >= 50, 0.1, 1.9 - 0.036 * gap))
    return np.where(power >= 50, 5.0, slow) * gap


def derivative(x: Array, u: Array) -> Array:
    """Return the derivative of speed, angle of attack, pitch angle, pitch rate, height and power."""
    speed, attack, pitch, rate, height, power = (x[..., i] for i in range(6))
    throttle, elevator = np.clip(u[..., 0], 0, 1), np.clip(u[..., 1], -25, 25)
    speed = np.maximum(speed, 100.0)
    cooled = 1 - 0.703e-5 * height
    mach = speed / np.sqrt(1.4 * 1716.3 * 519 * cooled)
    pressed = 0.5 * 2.377e-3 * cooled**4.14 * speed**2 * AREA
    degrees = attack * DEGREES
    damping = linear(degrees, ATTACK, DAMPING) * (CHORD * rate / (2 * speed))[..., None]
    ahead = bilinear(elevator, degrees, ELEVATOR, ATTACK, DRAG) + damping[..., 0]
    down = linear(degrees, ATTACK, LIFT) - 0.19 * elevator / 25 + damping[..., 1]
    turning = bilinear(elevator, degrees, ELEVATOR, ATTACK, PITCHING) + damping[..., 2]
    along, across = speed * np.cos(attack), speed * np.sin(attack)
    faster = -rate * across - GRAVITY * np.sin(pitch) + INVERSE_MASS * (pressed * ahead + thrust(power, height, mach))
    lower = rate * along + GRAVITY * np.cos(pitch) + INVERSE_MASS * pressed * down
    return np.stack(
        [
            (along * faster + across * lower) / speed,
            (along * lower - across * faster) / speed**2,
            rate,
            pressed * CHORD * INVERSE_INERTIA * turning,
            speed * np.sin(pitch - attack),
            power_rate(power, throttle),
        ],
        axis=-1,
    )


TRIM = (502.0, 0.03691, 0.03691, 0.0, 0.0, 64.94 * 0.1385)
"""The published state of level flight at sea level, table 3.6-2 of the second edition of Stevens and Lewis."""
TRIM_INPUT = (0.1385, -0.7588)


def pull_up(p: Parameters) -> Task:
    """Return the task: from a dive to a climb."""
    attack = 0.05 + 0.0 * p.dive
    first, last = p.dive + attack, p.climb + attack
    pitch, rate = path(HORIZON, DT, first, last)
    still = np.zeros_like(pitch)
    held = (np.asarray(part)[..., None] + still for part in (p.speed, attack))
    reference = np.stack([*held, pitch, rate, np.asarray(p.height)[..., None] + still, 20.0 + still], axis=-1)
    start = [p.speed, attack, first, p.rate, p.height, 20.0]
    return Task(start, reference=reference, horizon=HORIZON, dt=DT)


def polynomial(data: Transitions) -> models.ScikitLearn:
    """Return a quadratic polynomial in standardised units, by ridge regression."""
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    return models.ScikitLearn.fit(
        make_pipeline(StandardScaler(), PolynomialFeatures(2, include_bias=False), Ridge(1e-4)), data
    )


def make(seed: int) -> Experiment:
    """Return the aircraft that pulls up under LQR; M is a quadratic polynomial, from flight near level. 5-D."""
    system = simulated(derivative, DT, substeps=2)
    low, high = [420, 0.0, -0.3, -0.15, 2000, 5], [580, 0.14, 0.3, 0.15, 8000, 45]
    data = record(system, low, high, [0.2, 3.0], DT, seed, rollouts=60, steps=8, around=[0.3, -2.0])
    return experiment(
        "f16-pull-up",
        "ft",
        space=TaskSpace(
            speed=(380, 620, "ft/s"),
            dive=(-0.7, -0.1, "rad"),
            climb=(0.0, 0.4, "rad"),
            rate=(-0.15, 0.15, "rad/s"),
            height=(2000, 10000, "ft"),
        ),
        task=pull_up,
        system=system,
        model=polynomial(data),
        synthesizer=controllers.LQR(
            [1e-4, 1.0, 200.0, 20.0, 0.0, 0.0], [10.0, 0.01], limits=[[0.0, 1.0], [-25.0, 25.0]]
        ),
        distance=distances.FinalState(components=(4,)),
    )
