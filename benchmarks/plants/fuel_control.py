"""Fuel control of a petrol engine: the benchmark AFC of the ARCH competition, as its polynomial model.

Source: Jin, Deshmukh, Kapinski, Ueda and Butts, *Powertrain Control Verification Benchmark*, HSCC 2014, section 3.3
(model III): the throttle actuator, the intake manifold, the cylinder and exhaust, and the observer and PI control of
the engine's computer, with the parameters c1 to c26 of its appendix. The mode is the normal one, in which the
reference of the air-fuel ratio is 14.7.

Differences from the source: control and plant share a step of 0.05 s; the engine's speed is a state that does not
change, because it belongs to the task.
"""

from __future__ import annotations

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, record, simulated

DT, HORIZON = 0.05, 80
STOICHIOMETRIC = 14.7
"""c11, the reference of the air-fuel ratio."""
RPM = 2 * np.pi / 60


def throttle_area(angle: Array) -> Array:
    """Return the polynomial of the throttle angle in degrees (c6 to c9)."""
    return np.asarray(2.821 - 0.05231 * angle + 0.10299 * angle**2 - 0.00063 * angle**3)


def pumped(pressure: Array, speed: Array) -> Array:
    """Return the air that the cylinders take, g/s before the factor 0.9 (c2 to c5); pressure in bar, speed in rad/s."""
    return np.asarray(-0.366 + 0.08979 * speed * pressure - 0.0337 * speed * pressure**2 + 0.0001 * speed**2 * pressure)


def throttle_flow(angle: Array, pressure: Array) -> Array:
    """Return the air that passes the throttle (c20 to c22 for the square root of the pressure ratio)."""
    return np.asarray(2 * throttle_area(angle) * (-2.3421 * pressure**2 + 2.7799 * pressure - 0.3273))


def fuel_command(x: Array) -> Array:
    """Return the fuel of feedforward and PI control (c13 is the proportional gain)."""
    trim = 1 + x[..., 4] + 0.04 * (x[..., 2] - STOICHIOMETRIC)
    return np.asarray(trim * pumped(x[..., 3], x[..., 5]) / STOICHIOMETRIC)


def derivative(x: Array, u: Array) -> Array:
    """Return the derivative of the state.

    Args:
        x: throttle angle (degrees), manifold pressure (bar), air-fuel ratio, estimated pressure (bar), integral of the
            control, engine speed (rad/s).
        u: commanded throttle angle (degrees), fuel (g/s).
    """
    angle, pressure, ratio, estimate, speed = (x[..., i] for i in (0, 1, 2, 3, 5))
    flow, fuel = throttle_flow(angle, pressure), u[..., 1]
    air = 0.9 * pumped(pressure, speed)
    burnt = 13.893 - 35.2518 * fuel + 20.7364 * fuel**2 + 2.6287 * air - 1.592 * air * fuel
    return np.stack(
        [
            10.0 * (u[..., 0] - angle),
            0.41328 * (flow - air),
            4.0 * (burnt - ratio),
            0.41328 * (flow - pumped(estimate, speed)),
            0.14 * (ratio - STOICHIOMETRIC),
            np.zeros_like(speed),
        ],
        axis=-1,
    )


def command(t: int, x: Array, task: Task) -> Array:
    """Return the commanded throttle angle of the task, and the fuel of the published control."""
    return np.stack([np.broadcast_to(task.reference[..., t, 0], x.shape[:-1]), fuel_command(x)], axis=-1)


def drive(p: Parameters) -> Task:
    """Return the task: from a pedal angle to another one and back again, with smooth edges."""
    time = np.arange(HORIZON + 1) * DT
    base, tip, start, width, speed = (
        np.asarray(part)[..., None] for part in (p.base, p.tip, p.start, p.width, p.speed)
    )
    # Edges of 0.1 s, because steps between two samples would make d a step function of their times.
    pressed = (np.tanh((time - start) / 0.1) - np.tanh((time - start - width) / 0.1)) / 2
    angle = base + tip * pressed
    rest = np.zeros_like(angle)
    reference = [angle, 0.95 + rest, STOICHIOMETRIC + rest, 0.8 + rest, rest, RPM * speed + rest]
    first = [p.base, 0.95, STOICHIOMETRIC, 0.8, 0.01, RPM * p.speed]
    return Task(first, reference=np.stack(reference, axis=-1), horizon=HORIZON, dt=DT)


def make(seed: int) -> Experiment:
    """Return the fuel control under a pulse of the pedal; M is linear, from gentle pedal movements. 5-D."""
    system = simulated(derivative, DT, substeps=5)  # the manifold is stiff behind an open throttle
    low, high = [14, 0.85, 14.2, 0.7, -0.02, 950 * RPM], [26, 1.02, 15.2, 0.85, 0.04, 1050 * RPM]
    data = record(system, low, high, [6.0, 0.03], DT, seed, around=[20.0, 0.40])
    return experiment(
        "fuel-control",
        "air-fuel ratio",
        space=TaskSpace(
            base=(8.8, 20, "deg"),
            tip=(0, 25, "deg"),
            start=(0.5, 1.5, "s"),
            width=(0.3, 2.5, "s"),
            speed=(900, 1100, "rpm"),
        ),
        task=drive,
        system=system,
        model=models.Linear.fit(data),
        synthesizer=controllers.Policy(command),
        distance=distances.WholeTrajectory(norm=np.inf, components=(2,)),
    )
