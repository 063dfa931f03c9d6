"""What the systems share on which certificates from learned dynamics are developed and reported.

``dynamics_development.py`` and ``dynamics_reporting.py`` list the systems, ``dynamics_truths.py`` finds their maxima.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ctxval import Experiment, Task, Trajectory, Transitions, Validation, rollout, systems
from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from ctxval.core.model import Step
from ctxval.systems.functions import Derivative
from misleading import PartlySeen

FAMILIES = ("smooth", "prior", "hidden", "contact", "stick-slip", "saturation", "switch", "cliff", "noise")


@dataclass(frozen=True)
class Entry:
    """A system, its model and its task space, for each seed.

    Attributes:
        name: of the entry, in files and tables.
        family: one of ``FAMILIES``; the paper's cases are ``smooth``.
        make: the experiment of a seed, which draws the data of M; in the family ``prior`` also the system.
        misleading: whether an assumption of a certificate from learned dynamics does not hold.
        without: the experiment without the mechanism that misleads; None if there is none.
        noise: the declared standard deviation of the process noise of each state in one step; None if none is declared.
        seeds: how many seeds ``dynamics_truths.py`` computes the truth of; costly systems have fewer.
    """

    name: str
    family: str
    make: Callable[[int], Experiment]
    misleading: bool = False
    without: Callable[[int], Experiment] | None = None
    noise: tuple[float, ...] | None = None
    seeds: int = 10

    def __call__(self, seed: int) -> Experiment:
        """Return the experiment of a seed."""
        return self.make(seed)

    def dimensions(self) -> tuple[int, int, int]:
        """Return the number of task parameters, the number of recorded states and inputs, and the horizon."""
        validation = self.make(0).validation
        plan = validation.plan(0.5 * (validation.space.low + validation.space.high))
        found = plan.model_trajectory
        return validation.space.dimension, found.states.shape[-1] + found.inputs.shape[-1], plan.task.horizon


def listed(*entries: Entry) -> dict[str, Entry]:
    """Return entries by name.

    Raises:
        ValueError: if two have one name, or a family is unknown.
    """
    by_name = {entry.name: entry for entry in entries}
    if len(by_name) < len(entries):
        raise ValueError("each entry needs a name of its own.")
    unknown = {entry.family for entry in entries} - set(FAMILIES)
    if unknown:
        raise ValueError(f"the families are {', '.join(FAMILIES)}, got {', '.join(sorted(unknown))}.")
    return by_name


def simulated(derivative: Derivative, dt: float, substeps: int = 1) -> systems.Simulated:
    """Return the system with this derivative; each step of it is that many steps of Runge-Kutta."""
    return systems.Simulated(repeated(systems.rk4(derivative, dt / substeps), substeps), vectorized=True)


def repeated(step: Step, times: int) -> Step:
    """Return the step that takes another one several times under the same input."""
    return step if times == 1 else partial(_repeated, step, times)


def _repeated(step: Step, times: int, x: Array, u: Array) -> Array:
    for _ in range(times):
        x = step(x, u)
    return x


def experiment(name: str, units: str, **parts: Any) -> Experiment:
    """Return an experiment of the parts of a validation."""
    return Experiment(name, Validation(**parts), units=units)


# References and data


def path(
    horizon: int, dt: float, start: Array, goal: Array, amplitude: Any = 0.0, frequency: Any = 0.0
) -> tuple[Array, Array]:
    """Return positions and speeds ``(..., H + 1)`` of a quintic from rest to rest, plus a sine wave.

    Args:
        horizon: H.
        dt: s.
        start, goal: shape ``(...)``.
        amplitude, frequency: of the sine wave, in the units of the position and in Hz, shape ``(...)``.
    """
    share, length = np.arange(horizon + 1) / horizon, horizon * dt
    way, wave = (goal - start)[..., None], np.asarray(amplitude)[..., None]
    turn = 2 * np.pi * np.asarray(frequency)[..., None]
    bend, slope = share**3 * (10 - 15 * share + 6 * share**2), 30 * share**2 * (1 - share) ** 2 / length
    phase = turn * share * length
    return start[..., None] + way * bend + wave * np.sin(phase), way * slope + wave * turn * np.cos(phase)


def record(
    system: systems.System,
    low: Sequence[float],
    high: Sequence[float],
    inputs: Sequence[float],
    dt: float,
    seed: int,
    rollouts: int = 30,
    steps: int = 20,
    around: Any = 0.0,
) -> Transitions:
    """Return short runs from seeded random states in a box, under seeded random inputs within their limits.

    Args:
        system: what is recorded.
        low, high: the box of the first states, shape ``(n,)``.
        inputs: the largest deviation of each input, shape ``(m,)``.
        dt: s.
        seed: of states and inputs.
        rollouts: number of runs.
        steps: of each run.
        around: the inputs that the deviations are added to, shape ``(m,)``.
    """
    rng = np.random.default_rng(seed)
    start = rng.uniform(low, high, (rollouts, len(low)))
    forces = around + rng.uniform(-1, 1, (steps, rollouts, len(inputs))) * np.asarray(inputs)
    return system.execute(lambda t, x: forces[t], Task(start, horizon=steps, dt=dt)).transitions()


# Systems that are no function of state and input


@dataclass(frozen=True)
class Noisy:
    """A system with process noise, which is drawn anew for each task.

    The noise is a function of the task and the seed, so an execution can be repeated, alone or in a batch.

    Attributes:
        step: of the system without noise.
        deviation: the standard deviation of the noise of each state in one step.
        seed: of the noise.
        realisation: the row of the noise that all tasks get, for averages over the noise; None draws it by the task.
    """

    step: Step
    deviation: tuple[float, ...]
    seed: int
    realisation: int | None = None

    batched = True

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the task's initial state over its horizon."""
        rng = np.random.default_rng(self.seed)
        bank = rng.normal(size=(_REALISATIONS, task.horizon, len(self.deviation))) * self.deviation
        noise, clock = bank[self._rows(task)], iter(range(task.horizon))
        return rollout(lambda x, u: self.step(x, u) + noise[..., next(clock), :], controller, task)

    def _rows(self, task: Task) -> Any:
        if self.realisation is not None:
            return np.full(task.batch_shape, self.realisation)
        ends = np.concatenate([task.initial_state, task.reference[..., -1, :], task.reference[..., 3, :]], axis=-1)
        # Rounded, because the last digits of a task may differ between a batch and a single task.
        rounded = np.round(ends, 8) + 0.0
        rows = [zlib.crc32(row.tobytes()) % _REALISATIONS for row in rounded.reshape(-1, rounded.shape[-1])]
        return np.reshape(rows, task.batch_shape)


_REALISATIONS = 1024


def realisations(validation: Validation, count: int) -> list[Validation]:
    """Return the validation with each of the first realisations of its noise; only itself if it has none."""
    noisy = validation.system
    if not isinstance(noisy, Noisy):
        return [validation]
    return [validation.with_parts(system=replace(noisy, realisation=row)) for row in range(count)]


def friction(velocity: Array, push: Array, grip: Any, dt: float) -> Array:
    """Return the velocities after a step with dry friction, which opposes motion and never reverses it.

    Args:
        velocity, push: the velocity and the acceleration without friction, vectors ``(..., k)``.
        grip: the largest deceleration by friction, shape ``(...)``.
        dt: s.
    """
    moved = velocity + dt * push
    speed = np.sqrt((moved**2).sum(axis=-1))
    kept = np.maximum(0.0, 1 - dt * grip / np.maximum(speed, 1e-12))
    return np.asarray(moved * kept[..., None])


# Systems drawn from a prior


@dataclass(frozen=True)
class RandomFunction:
    """A draw of a stationary Gaussian process by random features (Rahimi and Recht 2007).

    Attributes:
        frequencies: shape ``(F, k)``.
        phases: shape ``(F,)``.
        weights: shape ``(F, outputs)``.
    """

    frequencies: Array
    phases: Array
    weights: Array

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        length_scales: Array,
        deviations: Array,
        smoothness: float = np.inf,
        features: int = 128,
    ) -> RandomFunction:
        """Draw a function.

        Args:
            rng: the generator.
            length_scales: shape ``(k,)``.
            deviations: of the outputs.
            smoothness: nu of the Matern kernel; infinity for the squared exponential.
            features: F.
        """
        frequencies = rng.normal(size=(features, len(length_scales))) / length_scales
        if np.isfinite(smoothness):
            frequencies /= np.sqrt(rng.chisquare(2 * smoothness, (features, 1)) / (2 * smoothness))
        weights = rng.normal(size=(features, len(deviations))) * np.sqrt(2 / features) * deviations
        return cls(frequencies, rng.uniform(0, 2 * np.pi, features), weights)

    def __call__(self, z: Array) -> Array:
        """Return the values at points ``(..., k)``, shape ``(..., outputs)``."""
        return np.asarray(np.cos(z @ self.frequencies.T + self.phases) @ self.weights)


__all__ = [
    "FAMILIES",
    "Entry",
    "Noisy",
    "PartlySeen",
    "RandomFunction",
    "experiment",
    "friction",
    "listed",
    "path",
    "realisations",
    "record",
    "repeated",
    "simulated",
]
