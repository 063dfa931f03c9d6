"""A cart with drag on suites of tasks."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctxval import Task, TaskSuite, Validation, controllers, distances, models, systems

COARSE = TaskSuite({f"{side} {size}": {"side": side, "size": size} for side in ("left", "right") for size in (1, 2, 3)})
FINE = TaskSuite({f"go to {goal:g}": {"goal": float(goal)} for goal in np.linspace(-2, 2, 41)})


def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    speed = x[..., 1]
    return np.asarray(x + 0.1 * np.stack([speed, u[..., 0] - 0.4 * speed - 0.2 * speed * np.abs(speed)], axis=-1))


def goal_of(p: Any) -> np.ndarray:
    return np.where(np.asarray(p.side) == "left", -0.9, 1.0) * p.size


def validation(suite: TaskSuite = COARSE, goal: Any = goal_of, system: Any = None, drag: float = 0.3) -> Validation:
    return Validation(
        space=suite,
        task=lambda p: Task(np.stack([0 * goal(p)] * 2, axis=-1), goal=[goal(p), 0.0], horizon=20, dt=0.1),
        system=systems.Simulated(step, vectorized=True) if system is None else system,
        model=models.Linear([[1.0, 0.1], [0.0, 1 - 0.1 * drag]], [[0.0], [0.1]]),
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )
