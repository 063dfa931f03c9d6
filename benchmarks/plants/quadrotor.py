"""A quadrotor with six degrees of freedom: the benchmark Quadrotor of the ARCH competition.

Sources: Beard, *Quadrotor Dynamics and Control*, Brigham Young University 2008, equations 16 to 19; the parameters and
the published controllers are those of Geretti et al., *ARCH-COMP21 Category Report: Continuous and Hybrid Systems with
Nonlinear Dynamics*, section on the quadrotor: mass 1.4 kg, rotors of 0.1 kg at 0.5 m from a centre of 0.1 m.

The state is position (north, east, height; m), velocity in the body's axes (m/s), roll, pitch and yaw (rad) and their
rates (rad/s). The vertical velocity of the body points downwards. Inputs are the thrust beyond the weight (N) and the
three torques (N m).
"""

from __future__ import annotations

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, record, simulated

DT, HORIZON = 0.05, 60
GRAVITY, CENTRE_MASS, ROTOR_MASS, RADIUS, ARM = 9.81, 1.0, 0.1, 0.1, 0.5
MASS = CENTRE_MASS + 4 * ROTOR_MASS
ROLL_INERTIA = 0.4 * CENTRE_MASS * RADIUS**2 + 2 * ARM**2 * ROTOR_MASS
YAW_INERTIA = 0.4 * CENTRE_MASS * RADIUS**2 + 4 * ARM**2 * ROTOR_MASS


def derivative(x: Array, u: Array) -> Array:
    """Return the derivative of the state under thrust beyond the weight and torques."""
    velocity, (p, q, r) = x[..., 3:6], np.moveaxis(x[..., 9:12], -1, 0)
    (sine_roll, sine_pitch, _), (cosine_roll, cosine_pitch, _) = (
        np.moveaxis(f(x[..., 6:9]), -1, 0) for f in (np.sin, np.cos)
    )
    longitudinal, lateral, vertical = np.moveaxis(velocity, -1, 0)
    turned = (sine_roll * q + cosine_roll * r) / cosine_pitch
    twist = (ROLL_INERTIA - YAW_INERTIA) / ROLL_INERTIA
    return np.stack(
        [
            *_moved(x[..., 6:9], velocity),
            r * lateral - q * vertical - GRAVITY * sine_pitch,
            p * vertical - r * longitudinal + GRAVITY * cosine_pitch * sine_roll,
            q * longitudinal - p * lateral + GRAVITY * (cosine_pitch * cosine_roll - 1) - u[..., 0] / MASS,
            p + sine_pitch * turned,
            cosine_roll * q - sine_roll * r,
            turned,
            twist * q * r + u[..., 1] / ROLL_INERTIA,
            -twist * p * r + u[..., 2] / ROLL_INERTIA,
            u[..., 3] / YAW_INERTIA + 0.0 * p,
        ],
        axis=-1,
    )


def _moved(angles: Array, velocity: Array) -> tuple[Array, Array, Array]:
    """Return the velocity in the world's axes: north, east, up."""
    (sr, sp, sy), (cr, cp, cy) = (np.moveaxis(f(angles), -1, 0) for f in (np.sin, np.cos))
    u, v, w = np.moveaxis(velocity, -1, 0)
    return (
        cp * cy * u + (sr * sp * cy - cr * sy) * v + (cr * sp * cy + sr * sy) * w,
        cp * sy * u + (sr * sp * sy + cr * cy) * v + (cr * sp * sy - sr * cy) * w,
        sp * u - sr * cp * v - cr * cp * w,
    )


def published_control(x: Array, height: float) -> Array:
    """Return the inputs of the published controllers, which hold a height, zero roll and zero pitch."""
    thrust = -10 * (x[..., 2] - height) + 3 * x[..., 5]
    return np.stack([thrust, -x[..., 6] - x[..., 9], -x[..., 7] - x[..., 10], 0 * thrust], axis=-1)


def fly(p: Parameters) -> Task:
    """Return the task: from a moving, tilted start to a position and a heading."""
    still = np.zeros((*p.start.shape[:-1], 9))
    start = np.concatenate([p.start, p.velocity, p.tilt, p.heading[..., None], still[..., :3]], axis=-1)
    return Task(start, goal=np.concatenate([p.goal, still], axis=-1), horizon=HORIZON, dt=DT)


def make(seed: int) -> Experiment:
    """Return the quadrotor under LQR; M is linear, from gentle flight around hovering. 12-D."""
    system = simulated(derivative, DT)
    box = np.array([1, 1, 1, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.2, 0.2, 0.2])
    data = record(system, list(-box), list(box), [1.0, 0.02, 0.02, 0.02], DT, seed, rollouts=40, steps=10)
    weights = [4, 4, 4, 1, 1, 1, 1, 1, 1, 0.1, 0.1, 0.1]
    return experiment(
        "quadrotor-3d",
        "m",
        space=TaskSpace(
            start=([-0.4] * 3, [0.4] * 3, "m"),
            velocity=([-0.4] * 3, [0.4] * 3, "m/s"),
            tilt=([-0.3] * 2, [0.3] * 2, "rad"),
            heading=(-0.6, 0.6, "rad"),
            goal=([-1.5, -1.5, 0], [1.5, 1.5, 1.5], "m"),
        ),
        task=fly,
        system=system,
        model=models.Linear.fit(data),
        synthesizer=controllers.LQR(weights, [0.1, 4, 4, 4]),
        distance=distances.MeanDeviation(components=(0, 1, 2), norm=2),
    )
