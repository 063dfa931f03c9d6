"""Plants on which verdicts under noise are calibrated, and the imperfections that each of them is given.

``noise_development.py`` and ``noise_reporting.py`` list plants. Rules may be chosen on those of the first list only.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval import Campaign, Experiment, Verdict, systems
from ctxval._util.arrays import Array
from ctxval.core.model import Step

IMPERFECTIONS: dict[str, dict[str, float]] = {
    "none": {},
    "process 0.1 %": {"process": 1e-3},
    "process 0.5 %": {"process": 5e-3},
    "process 1 %": {"process": 1e-2},
    "measurement 0.1 %": {"measurement": 1e-3},
    "measurement 0.5 %": {"measurement": 5e-3},
    "measurement 1 %": {"measurement": 1e-2},
    "both 0.1 %": {"process": 1e-3, "measurement": 1e-3},
    "encoder 0.1 %": {"resolution": 1e-3},
    "delay 1": {"delay": 1.0},
    "delay 1.5": {"delay": 1.5},
    "delay 3": {"delay": 3.0},
    "lag 2": {"lag": 2.0},
}
"""Noise and resolution as shares of the range of each state; delays and time constants in steps."""


def random_and_corners(d: int, rng: np.random.Generator) -> Array:
    """Return 2,000 random tasks and all corners, points of the unit cube."""
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * d), axis=-1).reshape(-1, d)
    return np.concatenate([rng.random((2000, d)), corners])


def near_best(points: Array, values: Array, share: float, moves: int, rng: np.random.Generator) -> Array:
    """Return the 40 best tasks, and so many tasks near each of them."""
    top = points[np.argsort(-values)[:40]]
    return np.clip(np.concatenate([top, *(top + share * rng.standard_normal(top.shape) for _ in range(moves))]), 0, 1)


def outcome(campaign: Campaign, verdict: Verdict, largest: float, started: float) -> dict[str, Any]:
    """Return what is stored of every campaign that was run until it was decided, begun at a CPU time."""
    return {
        "answer": verdict.answer,
        "executions": campaign.executions,
        "bound": None if verdict.bound is None else verdict.bound / largest,
        "reason": verdict.reason[:300],
        "seconds": round(time.process_time() - started, 1),
    }


@dataclass(frozen=True)
class Plant:
    """A plant with its model, tasks and controller.

    Attributes:
        make: the experiment with a given system, for a seed.
        step: the step of the system, of batches.
        ranges: the range of each state in the tasks, shape ``(n,)``.
    """

    name: str
    make: Callable[[int, Any], Experiment]
    step: Step
    ranges: tuple[float, ...]

    def __call__(self, imperfection: str, seed: int = 0) -> Experiment:
        """Return the experiment in which the system has an imperfection; noise follows from the seed."""
        settings: dict[str, Any] = dict(IMPERFECTIONS[imperfection])
        for name in {"process", "measurement", "resolution"} & set(settings):
            settings[name] = settings[name] * np.array(self.ranges)
        return self.make(seed, systems.Imperfect(self.step, vectorized=True, seed=seed, **settings))
