"""The reporting systems of strangers whose drives have a memory that is not recorded, or a threshold.

Listed with the others in ``strangers_reporting.py``. The second argument of each function is the size of the mechanism;
at 0 there is none. M is learned without it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, path, record, simulated
from strangers import Unrecorded, drawn, moved, norm, row, still, stranger, transfer, with_memory

# Hidden modes


def tripped_fuse(seed: int, loss: float = 0.5) -> Experiment:
    """Return a plotter on two axes, whose fuse halves its drive for good after three hard steps in a row. 6-D."""
    dt, horizon = 0.05, 45
    limit = drawn(seed, 271, 2.4, 2.5)

    def derivative(x: Array, u: Array, counted: Array) -> Array:
        rate = x[..., 2:]
        drive = np.where(counted >= 3, 1 - loss, 1.0)[..., None] * u
        return np.concatenate([rate, drive - 0.8 * rate - 0.3 * np.abs(rate) * rate], axis=-1)

    def renewed(x: Array, u: Array, counted: Array) -> Array:
        hard = np.abs(u).max(axis=-1) > limit
        return np.where(counted >= 3, counted, np.where(hard, counted + 1, 0.0))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "tripped-fuse",
        "m",
        space=TaskSpace(
            start=([-1] * 2, [1] * 2, "m"), speed=([-0.5] * 2, [0.5] * 2, "m/s"), goal=([-1] * 2, [1] * 2, "m")
        ),
        task=lambda p: transfer(horizon, dt, p.start, p.goal, p.speed),
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-1, -1, -0.4, -0.4], [1, 1, 0.4, 0.4], [1.5, 1.5], dt, seed)),
        synthesizer=controllers.LQR([20.0, 20.0, 1.0, 1.0], [0.2, 0.2]),
        distance=distances.MeanDeviation(components=(0, 1)),
    )


def slipped_cup(seed: int, lost: float = 0.4) -> Experiment:
    """Return a suction gripper that loses a part of its load for good if it is lifted too briskly; M holds it. 3-D."""
    dt, horizon = 0.05, 40
    limit = drawn(seed, 272, 1.55, 1.65)

    def derivative(x: Array, u: Array, gone: Array) -> Array:
        speed = x[..., 1]
        return np.stack([speed, (u[..., 0] + 9.81) * (1 + gone) - 9.81 - 0.5 * speed - 0.2 * speed**3], axis=-1)

    def renewed(x: Array, u: Array, gone: Array) -> Array:
        return np.maximum(gone, lost * (x[..., 1] > limit))

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "slipped-cup",
        "m",
        space=TaskSpace(start=(0, 1, "m"), speed=(-0.5, 0.5, "m/s"), goal=(0.5, 2, "m")),
        task=lambda p: transfer(horizon, dt, row(p.start), row(p.goal), row(p.speed)),
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [0, -0.4], [2, 0.4], [2.0], dt, seed)),
        synthesizer=controllers.LQR([50.0, 4.0], [0.05]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


# Heat and hysteresis


def warm_belt(seed: int, softening: float = 0.5) -> Experiment:
    """Return a belt drive whose belt softens as flexing warms it; M knows it cold. 5-D."""
    dt, horizon = 0.04, 60

    def derivative(x: Array, u: Array, heat: Array) -> Array:
        gap, speed = x[..., 1] - x[..., 0], x[..., 3] - x[..., 2]
        belt = 30.0 * gap / (1 + heat) + 0.8 * speed
        drag = 0.2 * x[..., 3] * np.abs(x[..., 3])
        return np.stack(
            [x[..., 2], x[..., 3], u[..., 0] + belt - 0.5 * x[..., 2], -belt - 0.3 * x[..., 3] - drag], axis=-1
        )

    def renewed(x: Array, u: Array, heat: Array) -> Array:
        bent = (x[..., 1] - x[..., 0]) * 30.0
        return heat + dt * (softening * bent**2 - 0.1 * heat)

    def shuttle(p: Parameters) -> Task:
        place, speed = path(horizon, dt, p.start, p.goal, p.wave, p.turns)
        reference = np.stack([place, place, speed, speed], axis=-1)
        return Task(row(p.start, p.start + p.stretch, 0, 0), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "warm-belt",
        "m",
        space=TaskSpace(
            start=(-1, 1, "m"),
            stretch=(-0.1, 0.1, "m"),
            goal=(-1, 1, "m"),
            wave=(0, 0.3, "m"),
            turns=(0.2, 0.8, "Hz"),
        ),
        task=shuttle,
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-0.3] * 4, [0.3] * 4, [2.0], dt, seed)),
        synthesizer=controllers.LQR([5.0, 10.0, 0.3, 0.3], [0.05]),
        distance=distances.WholeTrajectory(components=(0, 1)),
    )


def magnetic_yoke(seed: int, width: float = 0.6) -> Experiment:
    """Return a magnetic drive whose force lags behind its current by loops of three widths; M has no loops. 4-D."""
    dt, horizon = 0.05, 50
    widths = width * np.array([0.3, 0.7, 1.2]) * drawn(seed, 273, 0.9, 1.1)

    def derivative(x: Array, u: Array, loops: Array) -> Array:
        speed = x[..., 1]
        return np.stack([speed, loops.mean(axis=-1) - 0.6 * np.sin(x[..., 0]) - 0.8 * speed], axis=-1)

    def renewed(x: Array, u: Array, loops: Array) -> Array:
        return np.clip(loops, u - widths, u + widths)

    def swing(p: Parameters) -> Task:
        return transfer(horizon, dt, row(p.start), row(p.goal), wave=row(p.wave), turns=row(p.turns))

    nominal = simulated(lambda x, u: derivative(x, u, u), dt)
    return experiment(
        "magnetic-yoke",
        "rad",
        space=TaskSpace(start=(-1, 1, "rad"), goal=(-1.2, 1.2, "rad"), wave=(0, 0.4, "rad"), turns=(0.2, 0.9, "Hz")),
        task=swing,
        system=with_memory(derivative, renewed, lambda task: np.zeros((*task.batch_shape, 3)), dt),
        model=models.Linear.fit(record(nominal, [-0.4, -0.4], [0.4, 0.4], [2.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 1.0], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


# Backlash, stall and slip


def loose_wrist(seed: int, play: float = 0.025) -> Experiment:
    """Return a wrist of two joints behind gears with play, whose motors are not recorded; M has tight gears. 6-D."""
    dt, horizon, stiffness = 0.04, 50, 60.0

    def derivative(loose: float, x: Array, u: Array, motor: Array) -> Array:
        rate, lead = x[..., 2:], motor - x[..., :2]
        tooth = np.maximum(lead - loose, 0.0) + np.minimum(lead + loose, 0.0)
        return np.concatenate([rate, stiffness * tooth - 8.0 * rate - 0.3 * rate[..., ::-1] * np.abs(rate)], axis=-1)

    def renewed(x: Array, u: Array, motor: Array) -> Array:
        return motor + np.clip(x[..., :2] + u / stiffness - motor, -0.12, 0.12)

    def turn(p: Parameters) -> Task:
        return transfer(horizon, dt, p.start, p.goal, wave=row(p.wave, 0.5 * p.wave), turns=row(p.turns, p.turns))

    def geared(loose: float) -> Unrecorded:
        return with_memory(
            partial(derivative, loose), renewed, lambda task: task.initial_state[..., :2], dt, substeps=2
        )

    return experiment(
        "loose-wrist",
        "rad",
        space=TaskSpace(
            start=([-1] * 2, [1] * 2, "rad"),
            goal=([-1] * 2, [1] * 2, "rad"),
            wave=(0, 0.3, "rad"),
            turns=(0.2, 0.8, "Hz"),
        ),
        task=turn,
        system=geared(play),
        model=models.Linear.fit(record(geared(0.0), [-0.5] * 4, [0.5] * 4, [5.0, 5.0], dt, seed)),
        synthesizer=controllers.LQR([40.0, 40.0, 1.0, 1.0], [0.03, 0.03]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def slack_cable(seed: int, slack: float = 0.15) -> Experiment:
    """Return a sled between winches whose cable hangs through and is taken up at every turn; M's is taut. 3-D."""
    dt, horizon = 0.08, 45

    def derivative(x: Array, u: Array, taken: Array) -> Array:
        speed = x[..., 1]
        return np.stack(
            [speed, np.maximum(taken * np.sign(u[..., 0]), 0) * u[..., 0] - 1.2 * speed - 0.1 * speed * np.abs(speed)],
            axis=-1,
        )

    def renewed(x: Array, u: Array, taken: Array) -> Array:
        return np.clip(taken + dt * u[..., 0] / slack, -1, 1) if slack else np.sign(u[..., 0])

    def pull(p: Parameters) -> Task:
        return transfer(horizon, dt, row(p.start), row(p.goal), wave=row(p.wave), turns=0.3)

    nominal = simulated(lambda x, u: derivative(x, u, np.sign(u[..., 0])), dt)
    return experiment(
        "slack-cable",
        "m",
        space=TaskSpace(start=(-1, 1, "m"), goal=(-1, 1, "m"), wave=(0, 0.4, "m")),
        task=pull,
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-1, -0.5], [1, 0.5], [1.0], dt, seed)),
        synthesizer=controllers.LQR([15.0, 1.0], [0.2]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def airlocked_pump(seed: int, loss: float = 0.5) -> Experiment:
    """Return a pump that draws air, and pumps half, if it runs hard from a low sump; M's sump is full. 3-D."""
    dt, horizon = 0.5, 40
    low = drawn(seed, 274, 0.48, 0.52)

    def derivative(lost: float, x: Array, u: Array) -> Array:
        sump, tank = x[..., 0], x[..., 1]
        air = (sump < low) & (u[..., 0] > 0.06)
        flow, back = u[..., 0] * (1 - lost * air), 0.05 * tank + 0.01 * tank**2
        return np.stack([back - flow + 0.01 * (1.2 - sump), flow - back], axis=-1)

    def fill(p: Parameters) -> Task:
        way, _ = path(horizon, dt, p.tank, p.goal)
        reference = np.stack([p.sump[..., None] + p.tank[..., None] - way, way], axis=-1)
        return Task(row(p.sump, p.tank), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(partial(derivative, 0.0), dt)
    return experiment(
        "airlocked-pump",
        "m",
        space=TaskSpace(sump=(0.9, 1.5, "m"), tank=(0.1, 0.6, "m"), goal=(0.3, 1.2, "m")),
        task=fill,
        system=simulated(partial(derivative, loss), dt),
        model=models.Linear.fit(record(nominal, [0.8, 0.1], [1.5, 0.6], [0.02], dt, seed, around=0.03)),
        synthesizer=controllers.LQR([0.0, 10.0], [10.0]),
        distance=distances.MeanDeviation(components=(1,)),
    )


def skidding_loco(seed: int, loss: float = 0.6) -> Experiment:
    """Return a locomotive whose wheels skid above a pull and regrip only at half of it; M never skids. 4-D."""
    dt, horizon = 0.1, 50
    grip = drawn(seed, 275, 1.6, 1.75)

    def derivative(x: Array, u: Array, skids: Array) -> Array:
        speed = x[..., 1]
        return np.stack([speed, (1 - loss * skids) * u[..., 0] - 0.1 * speed - 0.1 * speed * np.abs(speed)], axis=-1)

    def renewed(x: Array, u: Array, skids: Array) -> Array:
        pull = np.abs(u[..., 0])
        return np.where(pull > grip, 1.0, np.where(pull < 0.5 * grip, 0.0, skids))

    def haul(p: Parameters) -> Task:
        return transfer(horizon, dt, row(p.start), row(p.goal), row(p.speed), row(p.wave), 0.25)

    nominal = simulated(lambda x, u: derivative(x, u, np.zeros(x.shape[:-1])), dt)
    return experiment(
        "skidding-loco",
        "m",
        space=TaskSpace(start=(-2, 0, "m"), speed=(-0.5, 0.5, "m/s"), goal=(0, 2, "m"), wave=(0, 0.2, "m")),
        task=haul,
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-2, -0.4], [2, 0.4], [0.6], dt, seed)),
        synthesizer=controllers.LQR([5.0, 1.0], [0.4]),
        distance=distances.MeanDeviation(components=(0,)),
    )


# Limits of rates, and delays


def slow_valve(seed: int, slowness: float = 1.0) -> Experiment:
    """Return a hydraulic boom on a spring, whose valve opens slowly and shuts at once; M's does both at once. 4-D."""
    dt, horizon = 0.05, 50
    limit = drawn(seed, 276, 9.0, 11.0) / slowness if slowness else np.inf

    def derivative(x: Array, u: Array, valve: Array) -> Array:
        place, speed, pressure = x[..., 0], x[..., 1], x[..., 2]
        moved_by = 6.0 * pressure - 3.0 * place - 1.0 * place**3 - 2.0 * speed
        return np.stack([speed, moved_by, 4.0 * (valve - pressure)], axis=-1)

    def renewed(x: Array, u: Array, valve: Array) -> Array:
        wider = np.abs(u[..., 0]) > np.abs(valve)
        return np.where(wider, valve + np.clip(u[..., 0] - valve, -limit * dt, limit * dt), u[..., 0])

    def lift(p: Parameters) -> Task:
        place, speed = path(horizon, dt, p.start, p.goal)
        reference = np.stack([place, speed, 0.5 * place], axis=-1)
        return Task(row(p.start, p.speed, p.pressure), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(lambda x, u: derivative(x, u, u[..., 0]), dt)
    return experiment(
        "slow-valve",
        "m",
        space=TaskSpace(start=(-1, 1, "m"), speed=(-1, 1, "m/s"), pressure=(-0.5, 0.5), goal=(-1, 1, "m")),
        task=lift,
        system=with_memory(derivative, renewed, still, dt),
        model=models.Linear.fit(record(nominal, [-0.4, -0.4, -0.4], [0.4, 0.4, 0.4], [1.0], dt, seed)),
        synthesizer=controllers.LQR([20.0, 1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def late_balance(seed: int, late: float = 1) -> Experiment:
    """Return a balancing robot that hears its commands one step late; M hears them at once. 3-D."""
    dt, horizon = 0.04, 80
    weight = drawn(seed, 277, 5.5, 6.5)

    def derivative(x: Array, u: Array) -> Array:
        tilt = x[..., 1]
        return np.stack([x[..., 2], x[..., 3], u[..., 0], weight * np.sin(tilt) - np.cos(tilt) * u[..., 0]], axis=-1)

    def step(x: Array, u: Array, waiting: list[Array], t: int) -> tuple[Array, list[Array]]:
        queue = [*waiting, u]
        return moved(lambda y: derivative(y, queue[0]), x, dt), queue[1:]

    def drive(p: Parameters) -> Task:
        place, speed = path(horizon, dt, 0 * p.goal, p.goal)
        reference = np.stack([place, 0 * place, speed, 0 * place], axis=-1)
        return Task(row(0, p.tilt, 0, p.rate), reference=reference, horizon=horizon, dt=dt)

    nominal = simulated(derivative, dt)
    low, high = [-1, -0.1, -0.3, -0.1], [1, 0.1, 0.3, 0.1]
    return experiment(
        "late-balance",
        "m",
        space=TaskSpace(tilt=(-0.2, 0.2, "rad"), rate=(-0.4, 0.4, "rad/s"), goal=(-1, 1, "m")),
        task=drive,
        system=Unrecorded(step, lambda task: [np.zeros((*task.batch_shape, 1))] * int(late)),
        model=models.Linear.fit(record(nominal, low, high, [1.0], dt, seed, steps=8)),
        synthesizer=controllers.LQR([5.0, 5.0, 1.0, 0.5], [0.3]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def far_from_the_mast(seed: int, late: float = 3) -> Experiment:
    """Return a radio-controlled cart that hears its commands three steps late beyond a range of its mast. 5-D."""
    dt, horizon = 0.05, 50
    reach = drawn(seed, 278, 1.1, 1.15)

    def derivative(x: Array, u: Array) -> Array:
        velocity = x[..., 2:]
        return np.concatenate([velocity, u - 0.3 * velocity - 0.3 * norm(velocity) * velocity], axis=-1)

    def step(x: Array, u: Array, waiting: list[Array], t: int) -> tuple[Array, list[Array]]:
        queue = [*waiting, u]
        heard = np.where(norm(x[..., :2]) > reach, queue[0], u)
        return moved(lambda y: derivative(y, heard), x, dt), queue[1:]

    def drive(p: Parameters) -> Task:
        return transfer(horizon, dt, np.stack(np.broadcast_arrays(0.0, p.y), axis=-1), p.goal, p.speed)

    nominal = simulated(derivative, dt)
    return experiment(
        "far-from-the-mast",
        "m",
        space=TaskSpace(y=(-1, 0, "m"), speed=([-1] * 2, [1] * 2, "m/s"), goal=([-1] * 2, [1] * 2, "m")),
        task=drive,
        system=Unrecorded(step, lambda task: [np.zeros((*task.batch_shape, 2))] * int(late)),
        model=models.Linear.fit(record(nominal, [-1, -1, -0.4, -0.4], [1, 1, 0.4, 0.4], [1.0] * 2, dt, seed)),
        synthesizer=controllers.LQR([60.0, 60.0, 1.0, 1.0], [0.015, 0.015]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


DRIVES = (
    stranger("tripped-fuse", "hidden", tripped_fuse),
    stranger("slipped-cup", "hidden", slipped_cup),
    stranger("warm-belt", "drift", warm_belt),
    stranger("magnetic-yoke", "hysteresis", magnetic_yoke),
    stranger("loose-wrist", "backlash", loose_wrist),
    stranger("slack-cable", "backlash", slack_cable),
    stranger("airlocked-pump", "stall", airlocked_pump),
    stranger("skidding-loco", "slip", skidding_loco),
    stranger("slow-valve", "rate-limit", slow_valve),
    stranger("late-balance", "delay", late_balance),
    stranger("far-from-the-mast", "delay", far_from_the_mast),
)
