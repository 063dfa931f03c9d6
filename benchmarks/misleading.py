"""Three systems built to mislead a search that learns their dynamics, and how it fares on them beside others.

In two of them a state is hidden, so that the residual r(x, u) that is learned does not exist as a function; in the
third a hard stop is met in one corner of the task space only, far from where all else points to. Distances are stored
in a file, a line for a case, a seed and a search, so a stopped study goes on; then the table is printed.
``python benchmarks/misleading.py --seeds 10``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ctxval import (
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
from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from ctxval.systems.functions import Derivative
from json_lines import JsonLines
from study_auto import Result, add_options, campaign, print_table, search_named, stored

HORIZON, DT = 60, 0.05
"""Steps, and s."""
ROLLOUTS, STEPS = 30, 20
"""Recorded for M: so many runs of 1 s."""


class PartlySeen:
    """A system of which only the first states are recorded and fed back; the others start at zero.

    Args:
        derivative: of all states.
        dt: s.
        hidden: how many states there are beyond those of a task.
    """

    batched = True

    def __init__(self, derivative: Derivative, dt: float, hidden: int) -> None:
        self.derivative, self.dt, self.hidden = derivative, dt, hidden

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the task's initial state, the hidden states at zero."""
        seen = task.initial_state.shape[-1]
        unseen = np.zeros((*task.batch_shape, self.hidden))
        whole = Task(np.concatenate([task.initial_state, unseen], axis=-1), horizon=task.horizon, dt=task.dt)
        system = systems.Simulated(systems.rk4(self.derivative, self.dt), vectorized=True)
        executed = system.execute(partial(_of_seen, controller, seen), whole)
        return Trajectory(executed.times, executed.states[..., :seen], executed.inputs, executed.ended)


def _of_seen(controller: Controller, seen: int, t: int, x: Array) -> Array:
    return controller(t, x[..., :seen])


@dataclass(frozen=True)
class HeatingDrive:
    """A pendulum hanging from a drive whose torque fades as it heats up; its temperature is not recorded.

    Attributes:
        gravity, friction: 1/s^2 and 1/s, over the inertia.
        heating: of the square of the torque; at 1 the drive has half its torque.
        cooling: s.
    """

    gravity: float = 4.0
    friction: float = 0.5
    heating: float = 0.03
    cooling: float = 10.0

    def derivative(self, x: Array, u: Array) -> Array:
        """Return the rates of (angle, rate, temperature) for torques over the inertia ``(..., 1)``, 1/s^2."""
        angle, rate, heat = x[..., 0], x[..., 1], x[..., 2]
        torque = u[..., 0] / (1 + heat)
        return np.stack(
            [
                rate,
                torque - self.gravity * np.sin(angle) - self.friction * rate,
                self.heating * u[..., 0] ** 2 - heat / self.cooling,
            ],
            axis=-1,
        )


@dataclass(frozen=True)
class FlexibleJoint:
    """A drive that moves a load over a spring; the load is not recorded.

    Attributes:
        stiffness: of the spring over the drive's inertia, 1/s^2.
        load: its inertia over that of the drive.
        damping, friction: of the spring and of the drive, 1/s.
    """

    stiffness: float = 30.0
    load: float = 1.0
    damping: float = 0.3
    friction: float = 1.0

    def derivative(self, x: Array, u: Array) -> Array:
        """Return the rates of (angle, rate, the load's lead, its rate of lead) for torques ``(..., 1)``, 1/s^2."""
        rate, lead, lead_rate = x[..., 1], x[..., 2], x[..., 3]
        spring = self.stiffness * (lead + lead**3) + self.damping * lead_rate
        driven = u[..., 0] + spring - self.friction * rate
        return np.stack([rate, driven, lead_rate, -spring / self.load - driven], axis=-1)


@dataclass(frozen=True)
class CartWithStop:
    """A cart on a rail with quadratic drag and, at one end, a stop.

    Attributes:
        drag: 1/m.
        stop: m; where it begins.
        stiffness, damping: of the stop over the cart's mass, 1/s^2 and 1/s.
    """

    drag: float = 0.4
    stop: float = 0.8
    stiffness: float = 900.0
    damping: float = 6.0

    def derivative(self, x: Array, u: Array) -> Array:
        """Return the rates of (position, speed) in m/s and m/s^2 for forces over the mass ``(..., 1)``, m/s^2."""
        position, speed = x[..., 0], x[..., 1]
        depth = np.maximum(position - self.stop, 0.0)
        pushed = np.maximum(self.stiffness * depth + self.damping * speed, 0.0) * (depth > 0)
        return np.stack([speed, u[..., 0] - self.drag * speed * np.abs(speed) - pushed], axis=-1)


# Tasks, and what M is learned from


def swing(p: Parameters) -> Task:
    """Return the task to turn from a start to a goal, swinging on the way."""
    share, turn = np.arange(HORIZON + 1) / HORIZON, 2 * np.pi * p.frequency[..., None] * HORIZON * DT
    way, amplitude = (p.goal - p.start)[..., None], p.amplitude[..., None]
    angle = p.start[..., None] + way * share + amplitude * np.sin(turn * share)
    rate = (way + amplitude * turn * np.cos(turn * share)) / (HORIZON * DT)
    return Task([p.start, 0.0], reference=np.stack([angle, rate], axis=-1), horizon=HORIZON, dt=DT)


def catch(p: Parameters) -> Task:
    """Return the task to bring a moving cart to a goal, and to swing there."""
    share, turn = np.arange(HORIZON + 1) / HORIZON, 2 * np.pi * p.frequency[..., None] * HORIZON * DT
    amplitude = p.amplitude[..., None]
    position = p.goal[..., None] + amplitude * np.sin(turn * share)
    speed = amplitude * turn * np.cos(turn * share) / (HORIZON * DT)
    return Task([p.start, p.speed], reference=np.stack([position, speed], axis=-1), horizon=HORIZON, dt=DT)


def record(system: systems.System, low: list[float], high: list[float], inputs: float, seed: int) -> Transitions:
    """Return short, gentle runs of a system from seeded random states in a box under seeded random inputs."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(low, high, (ROLLOUTS, 2))
    forces = rng.uniform(-inputs, inputs, (STEPS, ROLLOUTS, 1))
    return system.execute(lambda t, x: forces[t], Task(start, horizon=STEPS, dt=DT)).transitions()


# The cases


def hidden_heat(seed: int) -> Experiment:
    """Return the drive that heats up; M knows it cold. The end of the task shows what the way there has heated."""
    system = PartlySeen(HeatingDrive().derivative, DT, hidden=1)
    validation = Validation(
        space=TaskSpace(start=(-1, 1, "rad"), goal=(-2, 2, "rad"), amplitude=(0, 1.5, "rad"), frequency=(0.1, 1, "Hz")),
        task=swing,
        system=system,
        model=models.Linear.fit(record(system, [-0.5, -0.5], [0.5, 0.5], 3.0, seed)),
        synthesizer=controllers.LQR([10.0, 1.0], [0.01]),
        distance=distances.FinalState(norm=2),
    )
    return Experiment("hidden-heat", validation, units="rad, rad/s")


def hidden_load(seed: int) -> Experiment:
    """Return the drive with a load on a spring; it resonates at a frequency within the task space."""
    system = PartlySeen(FlexibleJoint().derivative, DT, hidden=2)
    validation = Validation(
        space=TaskSpace(start=(-1, 1, "rad"), goal=(-2, 2, "rad"), amplitude=(0, 1, "rad"), frequency=(0.1, 2, "Hz")),
        task=swing,
        system=system,
        model=models.Linear.fit(record(system, [-0.5, -0.5], [0.5, 0.5], 3.0, seed)),
        synthesizer=controllers.LQR([10.0, 1.0], [0.1]),
        distance=distances.WholeTrajectory(),
    )
    return Experiment("hidden-load", validation, units="rad, rad/s")


def corner_stop(seed: int) -> Experiment:
    """Return the cart with a stop, which one task in sixty meets; the drag alone is worst at the other end."""
    cart = CartWithStop()
    system = systems.Simulated(systems.rk4(cart.derivative, DT), vectorized=True)
    validation = Validation(
        space=TaskSpace(
            start=(-1, 0.5, "m"),
            speed=(-2, 2, "m/s"),
            goal=(-2, 0.7, "m"),
            amplitude=(0, 0.3, "m"),
            frequency=(0.1, 0.5, "Hz"),
        ),
        task=catch,
        system=system,
        model=models.Linear.fit(record(system, [-1.5, -0.5], [-0.5, 0.5], 1.0, seed)),
        synthesizer=controllers.LQR([10.0, 1.0], [1.0]),
        distance=distances.WholeTrajectory(components=(0,)),
    )
    return Experiment("corner-stop", validation, units="m")


CASES: dict[str, Callable[[int], Experiment]] = {
    "hidden-heat": hidden_heat,
    "hidden-load": hidden_load,
    "corner-stop": corner_stop,
}
BUDGET = 25


def truth(found: Experiment, folder: Path) -> float:
    """Return the maximum, which a large search finds in so few dimensions."""
    return cached_truth(
        found.validation, partial(search_truth, population=30, generations=60, climbs=6), folder
    ).distance


def run(case: str, seed: int, search: str, results: JsonLines, truths: Path) -> Result:
    """Return one campaign of a case, running what is not stored."""

    def compute() -> Result:
        found = CASES[case](seed)
        return campaign(found.validation, search_named(search), seed, BUDGET, truth(found, truths))

    return stored(results, case, seed, search, compute)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES), help=f"of {', '.join(CASES)}")
    parser.add_argument("--search", nargs="+", default=["auto", "scalar", "random"])
    add_options(parser, "misleading")
    options = parser.parse_args()
    print_table(options, run)


if __name__ == "__main__":
    main()
