"""What the systems share on which verdicts are calibrated that could embarrass: systems of strangers.

Each is a deterministic system with something that its model misses. ``strangers_development.py`` and
``strangers_reporting.py`` list them, and ``strangers_truths.py`` finds their maxima. Nothing is ever tuned on those of
the second list.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval import Experiment, Task, Trajectory, rollout
from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from dynamics_systems import Entry, path

FAMILIES = (
    *("task", "contact", "pocket", "hidden", "drift", "hysteresis", "backlash", "stall", "slip"),
    *("rate-limit", "delay", "payload", "wind", "far", "smooth"),
)
"""Dynamics by task; walls and thresholds; small places; latched modes; heat; ...; M far from its data; all else."""


@dataclass(frozen=True)
class Stranger(Entry):
    """A system, its model and its task space, for each seed.

    ``misleading`` says whether an assumption of a certificate from learned dynamics does not hold. If not, the system
    is regular: what M misses is a smooth function of recorded state and input, and a verdict is possible.

    Attributes:
        hints: tasks ``(k, d)`` of a seed near which the effect lives, for the search of the maximum; None if random
            tasks meet it anyway.
    """

    hints: Callable[[int], Array] | None = None
    seeds: int = 2


def gathered(*entries: Stranger) -> dict[str, Stranger]:
    """Return entries by name.

    Raises:
        ValueError: if two have one name, a family is unknown, or a misleading one does not say what it is without.
    """
    by_name = {entry.name: entry for entry in entries}
    if len(by_name) < len(entries):
        raise ValueError("each entry needs a name of its own.")
    for entry in entries:
        if entry.family not in FAMILIES:
            raise ValueError(f"the families are {', '.join(FAMILIES)}, got {entry.family}.")
        if entry.misleading and entry.without is None:
            raise ValueError(f"{entry.name} misleads, so it must say what it is without the mechanism.")
    return by_name


def stranger(name: str, family: str, make: Callable[..., Experiment], **options: Any) -> Stranger:
    """Return a misleading entry whose mechanism is the second argument of its function; at 0 there is none."""
    return Stranger(name, family, make, misleading=True, without=_Without(make), **options)


@dataclass(frozen=True)
class _Without:
    make: Callable[..., Experiment]

    def __call__(self, seed: int) -> Experiment:
        return self.make(seed, 0.0)


# Systems whose next state is no function of the recorded state and input


@dataclass(frozen=True)
class Unrecorded:
    """A system that knows its task and the time, and has a memory. None of them is recorded.

    Attributes:
        step: function of states ``(..., n)``, inputs ``(..., m)``, the memory and the index of the step, which returns
            the next states and the next memory.
        memory: function of the task, which returns the memory at its start.
    """

    step: Callable[[Array, Array, Any, int], tuple[Array, Any]]
    memory: Callable[[Task], Any]

    batched = True

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the task's initial state over its horizon."""
        held, clock = self.memory(task), iter(range(task.horizon))

        def step(x: Array, u: Array) -> Array:
            nonlocal held
            following, held = self.step(x, u, held, next(clock))
            return following

        return rollout(step, controller, task)


def by_task(
    derivative: Callable[[Array, Array, Array], Array], setting: Callable[[Any], Array], dt: float
) -> Unrecorded:
    """Return a system whose derivative ``(x, u, setting)`` has a setting that the task decides."""
    return Unrecorded(lambda x, u, held, t: (moved(lambda y: derivative(y, u, held), x, dt), held), setting)


def by_time(derivative: Callable[[Array, Array, float], Array], dt: float, substeps: int = 1) -> Unrecorded:
    """Return a system whose derivative ``(x, u, seconds)`` changes with time, in steps of the controller."""
    return Unrecorded(
        lambda x, u, held, t: (moved(lambda y: derivative(y, u, t * dt), x, dt, substeps), held), lambda task: None
    )


def with_memory(
    derivative: Callable[[Array, Array, Array], Array],
    renewed: Callable[[Array, Array, Array], Array],
    first: Callable[[Task], Array],
    dt: float,
    substeps: int = 1,
) -> Unrecorded:
    """Return a system with a memory that is renewed before each step.

    Args:
        derivative: of states, inputs and memory.
        renewed: the next memory of states, inputs and memory.
        first: the memory at the start of a task.
        dt: s.
        substeps: of Runge-Kutta in each step.
    """

    def step(x: Array, u: Array, held: Array, t: int) -> tuple[Array, Array]:
        following = renewed(x, u, held)
        return moved(lambda y: derivative(y, u, following), x, dt, substeps), following

    return Unrecorded(step, first)


def delayed(derivative: Callable[[Array, Array], Array], dt: float, steps: int, inputs: int) -> Unrecorded:
    """Return a system that receives its inputs some steps late, and none before the first arrives."""

    def step(x: Array, u: Array, waiting: list[Array], t: int) -> tuple[Array, list[Array]]:
        queue = [*waiting, u]
        return moved(lambda y: derivative(y, queue[0]), x, dt), queue[1:]

    return Unrecorded(step, lambda task: [np.zeros((*task.batch_shape, inputs))] * steps)


def moved(rate: Callable[[Array], Array], x: Array, dt: float, substeps: int = 1) -> Array:
    """Return the states after so many steps of Runge-Kutta."""
    h = dt / substeps
    for _ in range(substeps):
        a = rate(x)
        b = rate(x + 0.5 * h * a)
        c = rate(x + 0.5 * h * b)
        x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))
    return x


def still(task: Task) -> Array:
    """Return a memory of one zero for each task, shape ``(...)``."""
    return np.zeros(task.batch_shape)


# Tasks


class Job(Task):
    """A task with properties that neither its start nor its reference shows, such as the surface or the load.

    Args:
        task: what is to be done.
        properties: shape ``(..., k)``; the system knows them, its model and its controller do not.
    """

    def __init__(self, task: Task, properties: Array) -> None:
        super().__init__(task.initial_state, horizon=task.horizon, dt=task.dt, reference=task.reference)
        self.properties = np.broadcast_to(properties, (*self.batch_shape, np.shape(properties)[-1]))

    def __getitem__(self, index: int) -> Job:
        """Return one task of the batch."""
        return Job(super().__getitem__(index), self.properties[index])

    def describe(self) -> dict[str, Any]:
        """Return what identifies one task in a store."""
        return {**super().describe(), "properties": self.properties.tolist()}


def row(*parts: Any) -> Array:
    """Return components ``(..., k)`` of parts: scalars ``(...)`` and numbers."""
    return np.stack(np.broadcast_arrays(*(np.asarray(part, dtype=float) for part in parts)), axis=-1)


def transfer(
    horizon: int, dt: float, start: Array, goal: Array, speed: Any = 0.0, wave: Any = 0.0, turns: Any = 0.0
) -> Task:
    """Return the task to move ``k`` positions from a start to a goal along a smooth path; states are (places, speeds).

    Args:
        horizon: H.
        dt: s.
        start, goal: shape ``(..., k)``.
        speed: the first speeds, shape ``(..., k)``.
        wave, turns: amplitude and frequency of a sine wave on the way, shape ``(..., k)``.
    """
    places, speeds = (np.swapaxes(one, -1, -2) for one in path(horizon, dt, start, goal, wave, turns))
    first = np.concatenate([start, np.broadcast_to(speed, start.shape)], axis=-1)
    return Task(first, reference=np.concatenate([places, speeds], axis=-1), horizon=horizon, dt=dt)


def norm(vectors: Array) -> Array:
    """Return the lengths ``(..., 1)`` of vectors ``(..., k)``; smooth at zero."""
    return np.sqrt((vectors**2).sum(axis=-1, keepdims=True) + 1e-9)


def drawn(seed: int, key: int, low: Any, high: Any) -> Any:
    """Return what a seed decides of a system: numbers between limits, a float or an array."""
    found = np.random.default_rng([seed, key]).uniform(low, high)
    return float(found) if np.ndim(found) == 0 else found
