"""The plants on which verdicts under noise are reported. Nothing is ever tuned on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.model import Step
from dynamics_systems import experiment
from noise_systems import Plant

Derivative = Callable[[Array, Array], Array]


def linear_model(derivative: Derivative, states: int, inputs: int, dt: float) -> models.Linear:
    """Return the linearisation at 0 of one step of Runge-Kutta."""
    step = systems.rk4(derivative, dt)
    h, x, u = 1e-5, np.zeros(states), np.zeros(inputs)
    A = np.stack([(step(x + h * e, u) - step(x - h * e, u)) / (2 * h) for e in np.eye(states)], axis=1)
    B = np.stack([(step(x, u + h * e) - step(x, u - h * e)) / (2 * h) for e in np.eye(inputs)], axis=1)
    return models.Linear(A, B)


def plant(
    name: str,
    units: str,
    *,
    true: Derivative,
    believed: Derivative,
    inputs: int,
    ranges: Sequence[float],
    space: TaskSpace,
    ends: Callable[[Parameters], tuple[list[Any], list[Any]]],
    weights: tuple[Sequence[float], Sequence[float]],
    compared: tuple[int, ...],
    horizon: int,
    dt: float,
) -> Plant:
    """Return a plant whose model is linear and whose controller is an LQR; ``ends`` gives start and goal of a task."""

    def task(p: Parameters) -> Task:
        start, goal = ends(p)
        return Task(start, goal=goal, horizon=horizon, dt=dt)

    def make(seed: int, system: Any) -> Experiment:
        del seed
        return experiment(
            name,
            units,
            space=space,
            task=task,
            system=system,
            model=linear_model(believed, len(ranges), inputs, dt),
            synthesizer=controllers.LQR(*weights),
            distance=distances.MaximumDeviation(components=compared),
            start_tolerance=5.0,
        )

    step: Step = systems.rk4(true, dt)
    return Plant(name, make, step, tuple(ranges))


def _stacked(*parts: Any) -> Array:
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def _maglev(bend: float, drag: float) -> Derivative:
    """A magnet that lifts a ball: gap and speed; unstable."""

    def derivative(x: Array, u: Array) -> Array:
        gap, speed = x[..., 0], x[..., 1]
        return _stacked(speed, 30 * gap + bend * gap**2 - 20 * u[..., 0] * (1 + 0.4 * gap * (bend > 0)) - drag * speed)

    return derivative


def _cart_pole(friction: float, nonlinear: bool) -> Derivative:
    """A pole on a cart: position, angle and their rates; unstable."""

    def derivative(x: Array, u: Array) -> Array:
        _, angle, speed, rate = (x[..., i] for i in range(4))
        force = u[..., 0] - friction * np.tanh(speed / 0.3) - 0.3 * friction * speed
        if not nonlinear:
            acceleration = force - 0.5 * 9.81 * angle
            return _stacked(speed, rate, acceleration, (9.81 * angle - acceleration) / 0.5 - 0.0 * rate)
        s, c = np.sin(angle), np.cos(angle)
        acceleration = (force + 0.5 * s * (0.5 * rate**2 - 9.81 * c)) / (1 + 0.5 * s**2)
        return _stacked(speed, rate, acceleration, (9.81 * s - acceleration * c) / 0.5 - 0.2 * friction * rate)

    return derivative


def _crane(drag: float, pull: float) -> Derivative:
    """A trolley with a hanging load: position, swing and their rates."""

    def derivative(x: Array, u: Array) -> Array:
        _, swing, speed, rate = (x[..., i] for i in range(4))
        s, c = (np.sin(swing), np.cos(swing)) if drag else (swing, np.ones_like(swing))
        acceleration = u[..., 0] - drag * speed * np.abs(speed) + pull * s
        return _stacked(speed, rate, acceleration, -9.81 * s - acceleration * c - 0.1 * drag * rate)

    return derivative


def _planar_quadrotor(mass: float, drag: float) -> Derivative:
    """A quadrotor in a plane: x, z, tilt and their rates; the inputs are deviations from hovering."""

    def derivative(x: Array, u: Array) -> Array:
        tilt, vx, vz, rate = x[..., 2], x[..., 3], x[..., 4], x[..., 5]
        thrust = (9.81 + u[..., 0]) / mass
        s, c = (np.sin(tilt), np.cos(tilt)) if drag else (tilt, np.ones_like(tilt))
        forward = -(thrust if drag else 9.81) * s - drag * vx * np.abs(vx)
        return _stacked(vx, vz, rate, forward, thrust * c - 9.81 - drag * vz, u[..., 1] - drag * rate)

    return derivative


def _chain(hardening: float, damping: float) -> Derivative:
    """Three carts with springs between them, of which the first is pushed: positions and speeds."""

    def derivative(x: Array, u: Array) -> Array:
        q, v = x[..., :3], x[..., 3:]
        stretch = np.diff(q, axis=-1)
        pull = 8 * stretch + hardening * stretch**3
        zero = np.zeros_like(pull[..., :1])
        force = np.concatenate([pull, zero], axis=-1) - np.concatenate([zero, pull], axis=-1) - damping * v
        push = np.concatenate([u, np.zeros_like(q[..., :2])], axis=-1)
        return np.concatenate([v, force + push], axis=-1)

    return derivative


def _ship(cubic: float, loss: float) -> Derivative:
    """The heading of a ship: angle, rate, and the angle of a slow rudder."""

    def derivative(x: Array, u: Array) -> Array:
        rate, rudder = x[..., 1], x[..., 2]
        return _stacked(rate, -0.4 * rate - cubic * rate**3 + 0.8 * (1 - loss) * rudder, 1.5 * (u[..., 0] - rudder))

    return derivative


def _tanks(bend: float, loss: float) -> Derivative:
    """Two coupled tanks, of which each has a pump: deviations of the levels."""

    def derivative(x: Array, u: Array) -> Array:
        def flow(h: Array) -> Array:
            return 0.5 * h - bend * h**2 / (1 + np.abs(h))

        first, second = x[..., 0], x[..., 1]
        between = 0.4 * (first - second)
        pumps = (1 - loss) * u
        return _stacked(pumps[..., 0] - between - flow(first), pumps[..., 1] + between - flow(second))

    return derivative


def _arm(load: float, friction: float) -> Derivative:
    """A planar arm with two joints, whose model decouples them: angles and rates."""

    def derivative(x: Array, u: Array) -> Array:
        second, rates = x[..., 1], x[..., 2:]
        a, b, c = 1.6 + load, 0.5 + load, 0.5 + 0.5 * load
        coupling = b * np.cos(second) if load or friction else np.zeros_like(second)
        m11, m12, m22 = a + 2 * coupling, c + coupling, c + np.zeros_like(second)
        bend = b * np.sin(second) if friction else np.zeros_like(second)
        r1, r2 = rates[..., 0], rates[..., 1]
        t1 = u[..., 0] + bend * (2 * r1 * r2 + r2**2) - friction * r1
        t2 = u[..., 1] - bend * r1**2 - friction * r2
        det = m11 * m22 - m12**2
        return _stacked(r1, r2, (m22 * t1 - m12 * t2) / det, (m11 * t2 - m12 * t1) / det)

    return derivative


PLANTS = {
    each.name: each
    for each in (
        plant(
            "maglev", "mm",
            true=_maglev(12.0, 0.6), believed=_maglev(0.0, 0.0), inputs=1, ranges=(1.6, 8.0),
            space=TaskSpace(goal=(-0.6, 0.6, "mm"), start=(-0.4, 0.4, "mm")),
            ends=lambda p: ([p.start, 0.0], [p.goal, 0.0]),
            weights=([40.0, 1.0], [0.5]), compared=(0,), horizon=40, dt=0.02,
        ),
        plant(
            "cart-pole", "m",
            true=_cart_pole(0.6, nonlinear=True), believed=_cart_pole(0.0, nonlinear=False), inputs=1,
            ranges=(2.0, 0.6, 3.0, 3.0),
            space=TaskSpace(goal=(-0.8, 0.8, "m"), tilt=(-0.2, 0.2, "rad"), start=(-0.4, 0.4, "m")),
            ends=lambda p: ([p.start, p.tilt, 0.0, 0.0], [p.goal, 0.0, 0.0, 0.0]),
            weights=([5.0, 10.0, 1.0, 1.0], [0.2]), compared=(0,), horizon=60, dt=0.05,
        ),
        plant(
            "crane", "m",
            true=_crane(0.25, 2.0), believed=_crane(0.0, 1.5), inputs=1, ranges=(3.0, 0.8, 2.5, 2.0),
            space=TaskSpace(goal=(-1.5, 1.5, "m"), swing=(-0.3, 0.3, "rad")),
            ends=lambda p: ([0.0, p.swing, 0.0, 0.0], [p.goal, 0.0, 0.0, 0.0]),
            weights=([4.0, 4.0, 2.0, 1.0], [0.5]), compared=(0,), horizon=60, dt=0.06,
        ),
        plant(
            "quadrotor", "m",
            true=_planar_quadrotor(1.06, 0.3), believed=_planar_quadrotor(1.0, 0.0), inputs=2,
            ranges=(3.0, 2.0, 0.8, 4.0, 2.0, 4.0),
            space=TaskSpace(x=(-1.5, 1.5, "m"), z=(-1.0, 1.0, "m"), tilt=(-0.2, 0.2, "rad")),
            ends=lambda p: ([0.0, 0.0, p.tilt, 0.0, 0.0, 0.0], [p.x, p.z, 0.0, 0.0, 0.0, 0.0]),
            weights=([4.0, 6.0, 2.0, 2.0, 2.0, 0.5], [0.5, 0.2]), compared=(0, 1), horizon=60, dt=0.05,
        ),
        plant(
            "chain", "m",
            true=_chain(6.0, 0.5), believed=_chain(0.0, 0.3), inputs=1, ranges=(2.0, 2.0, 2.0, 3.0, 3.0, 3.0),
            space=TaskSpace(goal=(-1.0, 1.0, "m"), first=(-0.3, 0.3, "m"), last=(-0.3, 0.3, "m")),
            ends=lambda p: ([p.first, 0.0, p.last, 0.0, 0.0, 0.0], [p.goal, p.goal, p.goal, 0.0, 0.0, 0.0]),
            weights=([1.0, 1.0, 4.0, 0.5, 0.5, 0.5], [0.1]), compared=(2,), horizon=80, dt=0.06,
        ),
        plant(
            "ship", "rad",
            true=_ship(0.9, 0.12), believed=_ship(0.0, 0.0), inputs=1, ranges=(2.4, 0.9, 1.5),
            space=TaskSpace(goal=(-1.2, 1.2, "rad"), turning=(-0.3, 0.3, "rad/s")),
            ends=lambda p: ([0.0, p.turning, 0.0], [p.goal, 0.0, 0.0]),
            weights=([4.0, 2.0, 0.2], [1.0]), compared=(0,), horizon=60, dt=0.1,
        ),
        plant(
            "tanks", "dm",
            true=_tanks(0.25, 0.1), believed=_tanks(0.0, 0.0), inputs=2, ranges=(2.0, 2.0),
            space=TaskSpace(goal=([-1, -1], [1, 1], "dm"), start=([-0.5, -0.5], [0.5, 0.5], "dm")),
            ends=lambda p: ([p.start[..., 0], p.start[..., 1]], [p.goal[..., 0], p.goal[..., 1]]),
            weights=([4.0, 4.0], [0.5, 0.5]), compared=(0, 1), horizon=40, dt=0.1,
        ),
        plant(
            "arm", "rad",
            true=_arm(0.15, 0.3), believed=_arm(0.0, 0.0), inputs=2, ranges=(2.0, 2.0, 4.0, 4.0),
            space=TaskSpace(first=(-1, 1, "rad"), second=(-1, 1, "rad")),
            ends=lambda p: ([0.0, 0.0, 0.0, 0.0], [p.first, p.second, 0.0, 0.0]),
            weights=([20.0, 20.0, 1.0, 1.0], [0.2, 0.2]), compared=(0, 1), horizon=50, dt=0.04,
        ),
    )
}  # fmt: skip
