"""Noisy carts that break an assumption of a verdict under noise, for the development of its rules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval import Experiment, Task, Trajectory, rollout
from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from noise_development import PLANTS as DEVELOPMENT
from noise_systems import Plant

_RANGES = np.array([4.0, 6.0])
_DT = 0.05

Step = Callable[[Array, Array, Array, Any, np.random.Generator, int], tuple[Array, Any]]
"""``(x, u, goal, memory, rng, t) -> next state, memory``."""


class Misleading:
    """A cart whose step knows the goal, has a memory and draws noise; the state is recorded."""

    batched = True

    def __init__(self, step: Step, seed: int) -> None:
        self._step, self._seed, self._executed = step, seed, 0

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the initial state of the task over its horizon."""
        self._executed += 1
        rng, memory, clock = np.random.default_rng([self._seed, self._executed]), None, iter(range(task.horizon))
        goal = task.reference[..., -1, 0]

        def step(x: Array, u: Array) -> Array:
            nonlocal memory
            following, memory = self._step(x, u, goal, memory, rng, next(clock))
            return following

        return rollout(step, controller, task)


def _moved(x: Array, force: Array) -> Array:
    return np.asarray(x + _DT * np.stack([x[..., 1], force], axis=-1))


def _drag(x: Array, factor: Any = 0.4) -> Array:
    return np.asarray(factor * x[..., 1] + 0.15 * x[..., 1] * np.abs(x[..., 1]))


def _noise(x: Array, rng: np.random.Generator, size: Any = 1e-3) -> Array:
    return np.asarray(size * _RANGES * rng.standard_normal(x.shape))


def _corner(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """The noise is 6 times as large beyond 1.2 m."""
    factor = np.where(x[..., :1] > 1.2, 6.0, 1.0)
    return _moved(x, u[..., 0] - _drag(x)) + _noise(x, rng, 1e-3 * factor), memory


def _coloured(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """The noise is correlated over 10 steps."""
    held = np.zeros_like(x) if memory is None else memory
    held = 0.9 * held + np.sqrt(1 - 0.81) * _noise(x, rng)
    return _moved(x, u[..., 0] - _drag(x)) + held, held


def _gusts(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """One execution of twenty has a gust."""
    if memory is None:
        shape = x.shape[:-1]
        memory = rng.random(shape) < 0.05, rng.integers(5, 35, shape)
    gust = 0.02 * 6.0 * (memory[0] & (np.abs(t - memory[1]) < 3))
    return _moved(x, u[..., 0] - _drag(x)) + _noise(x, rng) + np.stack([0 * gust, gust], axis=-1), memory


def _latched(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """Beyond a place and a speed, the drag stays large."""
    on = np.zeros(x.shape[:-1], dtype=bool) if memory is None else memory
    on = on | ((x[..., 0] > 1.0) & (x[..., 1] > 0.8))
    return _moved(x, u[..., 0] - _drag(x, np.where(on, 2.0, 0.4))) + _noise(x, rng), on


def _payload(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """In a tenth of the goals, there is a load."""
    gain = np.where((goal > 0.8) & (goal < 1.2), 0.55, 1.0)
    return _moved(x, gain * u[..., 0] - _drag(x)) + _noise(x, rng), memory


def _sticking(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """The wheels stick at rest."""
    speed, push = x[..., 1], u[..., 0]
    stuck = (np.abs(speed) < 0.02) & (np.abs(push) < 0.8)
    after = speed + _DT * (push - 0.3 * speed - 0.5 * np.sign(speed))
    after = np.where(stuck | (after * speed < 0), 0.0, after)
    return np.stack([x[..., 0] + _DT * speed, after], axis=-1) + _noise(x, rng, 2e-4), memory


def _warming(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """The motor loses strength as it works, and is cold again at the next start."""
    heat = np.zeros(x.shape[:-1]) if memory is None else memory
    heat = heat + 0.02 * np.abs(u[..., 0])
    return _moved(x, u[..., 0] / (1 + heat) - _drag(x)) + _noise(x, rng), heat


def _wall(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """A soft stop at -1.7 m."""
    stop = 60.0 * np.maximum(-1.7 - x[..., 0], 0.0)
    return _moved(x, u[..., 0] - _drag(x) + stop) + _noise(x, rng), memory


def _dropouts(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """One record of thirty is that of the step before."""
    true = x if memory is None else memory
    true = _moved(true, u[..., 0] - _drag(true)) + _noise(true, rng, 2e-4)
    return np.where(rng.random((*x.shape[:-1], 1)) < 1 / 30, x, true), true


def _battery(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """The motor has another strength in each execution, between 85 and 100 %."""
    strength = rng.uniform(0.85, 1.0, x.shape[:-1]) if memory is None else memory
    return _moved(x, strength * u[..., 0] - _drag(x)) + _noise(x, rng), strength


def _bump(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """In an eighth of the goals, a quarter of the executions meet a bump."""
    hit = rng.random(x.shape[:-1]) < 0.25 if memory is None else memory
    bump = 0.2 * (hit & (goal > 0.5) & (goal < 1.0) & (np.abs(t - 20) < 4))
    return _moved(x, u[..., 0] - _drag(x)) + _noise(x, rng) + np.stack([0 * bump, bump], axis=-1), hit


def _wet(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """One execution of eight is on a wet floor, where the wheels slip."""
    wet = rng.random(x.shape[:-1]) < 0.125 if memory is None else memory
    return _moved(x, np.where(wet, 0.6, 1.0) * u[..., 0] - _drag(x)) + _noise(x, rng), wet


def _zeroed(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """The force has another offset in each execution."""
    offset = 0.15 * rng.standard_normal(x.shape[:-1]) if memory is None else memory
    return _moved(x, u[..., 0] + offset - _drag(x)) + _noise(x, rng), offset


def _weak(x: Array, u: Array, goal: Array, memory: Any, rng: np.random.Generator, t: int) -> tuple[Array, Any]:
    """Without noise: in a twentieth of the goals, the motor has 12 % less strength."""
    gain = np.where((goal > 1.7) & (goal < 1.9), 0.88, 1.0)
    return _moved(x, gain * u[..., 0] - _drag(x)), memory


@dataclass(frozen=True)
class MisleadingPlant(Plant):
    """A cart that misleads.

    Attributes:
        misled: its step.
    """

    misled: Step | None = None

    def __call__(self, imperfection: str, seed: int = 0) -> Experiment:
        """Return the experiment of a seed; the noise is that of the cart."""
        assert self.misled is not None
        return self.make(seed, Misleading(self.misled, seed))


_CART = DEVELOPMENT["cart"]

PLANTS = {
    name: MisleadingPlant(name, _CART.make, _CART.step, _CART.ranges, step)
    for name, step in {
        "weak": _weak,
        "bump": _bump,
        "wet": _wet,
        "zeroed": _zeroed,
        "corner": _corner,
        "coloured": _coloured,
        "gusts": _gusts,
        "latched": _latched,
        "payload": _payload,
        "sticking": _sticking,
        "warming": _warming,
        "wall": _wall,
        "dropouts": _dropouts,
        "battery": _battery,
    }.items()
}
