"""The development systems of strangers whose drives have a memory that is not recorded, or a threshold.

Listed with the others in ``strangers_development.py``. The second argument of each function is the size of the
mechanism; at 0 there is none. M is learned without it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, path, record, simulated
from strangers import delayed, drawn, row, still, stranger, transfer, with_memory

# Hidden modes


def latched_brake(seed: int, brake: float = 1.5) -> Experiment:
    """Return a trolley whose safety brake latches above a speed and drags for the rest of the task. 3-D."""
    dt, horizon = 0.05, 50
    limit = drawn(seed, 221, 1.2, 1.3)

    def derivative(x: Array, u: Array, latched: Array) -> Array:
        speed = x[..., 1]
        return np.stack([speed, u[..., 0] - (0.3 + latched) * speed - 0.2 * speed * np.abs(speed)], axis=-1)

    def renewed(x: Array, u: Array, latched: Array) -> Array:
        return np.maximum(latched, brake * (np.abs(x[..., 1]) > limit))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "latched-brake",
        "m",
        space=TaskSpace(start=(-1, 1, "m"), speed=(-1, 1, "m/s"), goal=(-1, 1, "m")),
        task=lambda p: transfer(horizon, dt, row(p.start), row(p.goal), row(p.speed)),
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-1, -0.5], [1, 0.5], [1.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 1.0], [0.2]),
        distance=distances.MeanDeviation(components=(0,)),
    )


def shifted_cargo(seed: int, moment: float = 0.8) -> Experiment:
    """Return a van whose cargo slides to one side in a hard turn and stays there, pulling its nose round. 4-D."""
    dt, horizon = 0.06, 50
    limit = drawn(seed, 222, 0.6, 0.65)

    def derivative(x: Array, u: Array, shifted: Array) -> Array:
        turned = 4.0 * (u[..., 0] - x[..., 2]) - 0.6 * x[..., 2] ** 3 + shifted
        return np.stack([6.0 * np.sin(x[..., 1]), x[..., 2], turned], axis=-1)

    def renewed(x: Array, u: Array, shifted: Array) -> Array:
        return np.where(shifted != 0, shifted, moment * np.sign(x[..., 2]) * (np.abs(x[..., 2]) > limit))

    def weave(p: Parameters) -> Task:
        place, slope = path(horizon, dt, p.offset, p.lane, p.wave, 0.2 + 0 * p.wave)
        reference = np.stack([place, slope / 6.0, 0 * place], axis=-1)
        return Task(row(p.offset, p.heading, 0), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "shifted-cargo",
        "m",
        space=TaskSpace(offset=(-2, 2, "m"), heading=(-0.3, 0.3, "rad"), lane=(-2, 2, "m"), wave=(0, 0.5, "m")),
        task=weave,
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-1, -0.2, -0.2], [1, 0.2, 0.2], [0.3], dt, seed, steps=10)),
        synthesizer=controllers.LQR([1.0, 10.0, 0.3], [3.0]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


# Heat and hysteresis


def warming_joint(seed: int, heating: float = 0.25) -> Experiment:
    """Return a geared joint whose friction falls as its work warms the grease; M knows it cold. 4-D."""
    dt, horizon = 0.05, 60

    def derivative(x: Array, u: Array, heat: Array) -> Array:
        rate = x[..., 1]
        return np.stack([rate, u[..., 0] - 4.0 * rate / (1 + heat) - 0.1 * rate * np.abs(rate)], axis=-1)

    def renewed(x: Array, u: Array, heat: Array) -> Array:
        return heat + dt * (heating * np.abs(u[..., 0] * x[..., 1]) - 0.1 * heat)

    def sway(p: Parameters) -> Task:
        return transfer(horizon, dt, row(p.start), row(p.goal), wave=row(p.wave), turns=row(p.turns))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "warming-joint",
        "rad",
        space=TaskSpace(start=(-1, 1, "rad"), goal=(-1, 1, "rad"), wave=(0, 0.5, "rad"), turns=(0.1, 0.7, "Hz")),
        task=sway,
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-1, -0.5], [1, 0.5], [3.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 1.0], [0.02]),
        distance=distances.FinalState(components=(0,)),
    )


def creeping_stage(seed: int, share: float = 0.4) -> Experiment:
    """Return a piezo stage, part of whose spring is hysteretic (Bouc and Wen); M has a plain spring. 3-D."""
    dt, horizon = 0.02, 60
    width = drawn(seed, 223, 0.25, 0.35)

    def derivative(x: Array, u: Array, lag: Array) -> Array:
        place, speed = x[..., 0], x[..., 1]
        spring = 25.0 * (place + share * (lag - place))
        return np.stack([speed, u[..., 0] - spring - 4.0 * speed - 2.0 * place**3], axis=-1)

    def renewed(x: Array, u: Array, lag: Array) -> Array:
        slip = np.clip(lag / width, -1, 1)
        return lag + dt * (x[..., 1] - np.abs(x[..., 1]) * slip) if share else x[..., 0]

    def scan(p: Parameters) -> Task:
        return transfer(horizon, dt, row(p.start), 0 * row(p.start), wave=row(p.wave), turns=row(p.turns))

    nominal = simulated(lambda x, u: derivative(x, u, x[..., 0]), dt)
    return experiment(
        "creeping-stage",
        "10 um",
        space=TaskSpace(start=(-0.8, 0.8, "10 um"), wave=(0, 0.8, "10 um"), turns=(0.5, 2, "Hz")),
        task=scan,
        system=with_memory(derivative, renewed, lambda task: task.initial_state[..., 0], dt),
        model=models.Linear.fit(record(nominal, [-0.5, -0.5], [0.5, 0.5], [8.0], dt, seed)),
        synthesizer=controllers.LQR([50.0, 0.1], [0.004]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def cooling_fan(seed: int, cooling: float = 0.35) -> Experiment:
    """Return a furnace whose fan starts above one temperature and stops far below it; M has no fan. 3-D."""
    dt, horizon = 0.2, 50
    on = drawn(seed, 224, 2.3, 2.4)

    def derivative(x: Array, u: Array, fan: Array) -> Array:
        oven, wall = x[..., 0], x[..., 1]
        lost = 0.5 * (oven - wall) + (0.02 * oven * np.abs(oven)) + cooling * fan * oven
        return np.stack([u[..., 0] - lost, 0.5 * (oven - wall) - 0.2 * wall], axis=-1)

    def renewed(x: Array, u: Array, fan: Array) -> Array:
        return np.where(x[..., 0] > on, 1.0, np.where(x[..., 0] < 1.5, 0.0, fan))

    def heat(p: Parameters) -> Task:
        way = path(horizon, dt, p.oven, p.goal)[0]
        return Task(row(p.oven, p.wall), reference=np.stack([way, 0.7 * way], axis=-1), horizon=horizon, dt=dt)

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "cooling-fan",
        "100 K",
        space=TaskSpace(oven=(0, 2, "100 K"), wall=(0, 1, "100 K"), goal=(0.3, 2.6, "100 K")),
        task=heat,
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [0, 0], [1.5, 1], [0.8], dt, seed)),
        synthesizer=controllers.LQR([10.0, 0.0], [0.2]),
        distance=distances.MeanDeviation(components=(0,)),
    )


# Backlash, stall, limits of rates, delays


def steering_play(seed: int, play: float = 0.12) -> Experiment:
    """Return a tractor whose steering wheel has play, which the wheels do not follow; M has none. 4-D."""
    dt, horizon, speed = 0.1, 45, 1.5

    def derivative(x: Array, u: Array, wheel: Array) -> Array:
        return np.stack([speed * np.sin(x[..., 1]), x[..., 2], 5.0 * (speed * np.tan(wheel) - x[..., 2])], axis=-1)

    def renewed(x: Array, u: Array, wheel: Array) -> Array:
        return np.clip(wheel, u[..., 0] - play, u[..., 0] + play).clip(-0.9, 0.9)

    def plough(p: Parameters) -> Task:
        place, slope = path(horizon, dt, p.row, p.goal, p.wave, 0.15 + 0 * p.wave)
        reference = np.stack([place, slope / speed, 0 * place], axis=-1)
        return Task(row(p.row, p.heading, 0), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(lambda x, u: derivative(x, u, u[..., 0]), dt)
    return experiment(
        "steering-play",
        "m",
        space=TaskSpace(row=(-1, 1, "m"), heading=(-0.4, 0.4, "rad"), goal=(-1, 1, "m"), wave=(0, 0.3, "m")),
        task=plough,
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-1, -0.2, -0.2], [1, 0.2, 0.2], [0.15], dt, seed, steps=10)),
        synthesizer=controllers.LQR([4.0, 2.0, 0.1], [2.0]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def stalled_conveyor(seed: int, loss: float = 0.6) -> Experiment:
    """Return a conveyor whose motor stalls if it must pull hard while it hardly turns; M never saw that. 1-D."""
    dt, horizon = 0.05, 40
    pull = drawn(seed, 225, 12.8, 13.4)

    def derivative(lost: float, x: Array, u: Array) -> Array:
        speed, push = x[..., 1], u[..., 0]
        stalled = (np.abs(push) > pull) & (np.abs(speed) < 0.4)
        return np.stack([speed, push * (1 - lost * stalled) - 1.5 * speed - 0.3 * speed * np.abs(speed)], axis=-1)

    nominal = simulated(partial(derivative, 0.0), dt)
    return experiment(
        "stalled-conveyor",
        "m",
        space=TaskSpace(goal=(-2, 2, "m")),
        task=lambda p: Task([0.0, 0.0], goal=row(p.goal, 0), horizon=horizon, dt=dt),
        system=simulated(partial(derivative, loss), dt),
        model=models.Linear.fit(record(nominal, [-1, -0.6], [1, 0.6], [2.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 2.0], [0.3]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def slow_gimbal(seed: int, slowness: float = 1.0) -> Experiment:
    """Return a camera on two axes whose drives change their torque no faster than a limit; M knows no limit. 6-D."""
    dt, horizon = 0.04, 50
    limit = drawn(seed, 226, 22.0, 28.0) / slowness if slowness else np.inf

    def derivative(x: Array, u: Array, torque: Array) -> Array:
        rate = x[..., 2:]
        coupled = 0.3 * rate[..., ::-1] * rate * np.array([1.0, -1.0])
        return np.concatenate([rate, torque - 0.5 * rate + coupled], axis=-1)

    def renewed(x: Array, u: Array, torque: Array) -> Array:
        return torque + np.clip(u - torque, -limit * dt, limit * dt)

    def look(p: Parameters) -> Task:
        return transfer(horizon, dt, p.start, p.goal, p.rate)

    nominal = simulated(lambda x, u: derivative(x, u, u), dt)
    return experiment(
        "slow-gimbal",
        "rad",
        space=TaskSpace(
            start=([-1] * 2, [1] * 2, "rad"), rate=([-1] * 2, [1] * 2, "rad/s"), goal=([-1] * 2, [1] * 2, "rad")
        ),
        task=look,
        system=with_memory(derivative, renewed, lambda task: np.zeros((*task.batch_shape, 2)), dt),
        model=models.Linear.fit(record(nominal, [-1, -1, -0.5, -0.5], [1, 1, 0.5, 0.5], [1.0, 1.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 20.0, 1.0, 1.0], [0.1, 0.1]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def slow_rudder(seed: int, slowness: float = 1.0) -> Experiment:
    """Return a ferry whose rudder turns slowly; M turns it at once. Only hard corrections meet the limit. 4-D."""
    dt, horizon = 0.2, 40
    limit = drawn(seed, 227, 0.75, 0.85) / slowness if slowness else np.inf

    def derivative(x: Array, u: Array, rudder: Array) -> Array:
        return np.stack([2.0 * np.sin(x[..., 1]), x[..., 2], 1.5 * rudder - x[..., 2] - 0.8 * x[..., 2] ** 3], axis=-1)

    def renewed(x: Array, u: Array, rudder: Array) -> Array:
        return rudder + np.clip(u[..., 0] - rudder, -limit * dt, limit * dt)

    nominal = simulated(lambda x, u: derivative(x, u, u[..., 0]), dt)
    return experiment(
        "slow-rudder",
        "m",
        space=TaskSpace(offset=(-2, 2, "m"), heading=(-0.4, 0.4, "rad"), turn=(-0.2, 0.2, "rad/s"), goal=(-1, 1, "m")),
        task=lambda p: Task(row(p.offset, p.heading, p.turn), goal=row(p.goal, 0, 0), horizon=horizon, dt=dt),
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-1, -0.3, -0.1], [1, 0.3, 0.1], [0.3], dt, seed, steps=10)),
        synthesizer=controllers.LQR([1.0, 4.0, 1.0], [4.0]),
        distance=distances.FinalState(components=(0, 1)),
    )


def late_cart(seed: int, late: float = 2) -> Experiment:
    """Return two carts on a spring whose drive hears every command two steps late; M hears it at once. 5-D."""
    dt, horizon = 0.05, 60
    stiffness = drawn(seed, 228, 7.0, 9.0)

    def derivative(x: Array, u: Array) -> Array:
        gap, speed = x[..., 1] - x[..., 0], x[..., 2:]
        spring = stiffness * gap + 1.5 * gap**3 + 0.3 * (x[..., 3] - x[..., 2])
        return np.stack(
            [x[..., 2], x[..., 3], u[..., 0] + spring - 0.4 * speed[..., 0], -spring - 0.2 * speed[..., 1]], axis=-1
        )

    def shift(p: Parameters) -> Task:
        place, speed = path(horizon, dt, p.start, p.goal, p.wave, p.turns)
        reference = np.stack([place, place, speed, speed], axis=-1)
        return Task(row(p.start, p.start + p.stretch, 0, 0), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(derivative, dt)
    return experiment(
        "late-cart",
        "m",
        space=TaskSpace(
            start=(-1, 1, "m"),
            stretch=(-0.2, 0.2, "m"),
            goal=(-1, 1, "m"),
            wave=(0, 0.2, "m"),
            turns=(0.1, 0.6, "Hz"),
        ),
        task=shift,
        system=delayed(derivative, dt, int(late), 1),
        model=models.Linear.fit(record(nominal, [-0.5] * 4, [0.5] * 4, [1.0], dt, seed)),
        synthesizer=controllers.LQR([5.0, 5.0, 0.5, 0.5], [0.2]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


DRIVES = (
    stranger("latched-brake", "hidden", latched_brake),
    stranger("shifted-cargo", "hidden", shifted_cargo),
    stranger("warming-joint", "drift", warming_joint),
    stranger("creeping-stage", "hysteresis", creeping_stage),
    stranger("cooling-fan", "hysteresis", cooling_fan),
    stranger("steering-play", "backlash", steering_play),
    stranger("stalled-conveyor", "stall", stalled_conveyor),
    stranger("slow-gimbal", "rate-limit", slow_gimbal),
    stranger("slow-rudder", "rate-limit", slow_rudder),
    stranger("late-cart", "delay", late_cart),
)
