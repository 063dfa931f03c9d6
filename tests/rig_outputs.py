"""A pendulum of which the angle alone is recorded."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctxval import Task, TaskSpace, Validation, controllers, distances, systems

DT, H = 0.05, 40


def swing(friction: float) -> Any:
    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        angle, rate = x[..., 0], x[..., 1]
        pushed = u[..., 0] - 2 * np.sin(angle) - friction * np.tanh(3 * rate)
        return np.stack([angle + DT * rate, rate + DT * pushed], axis=-1)

    return step


class Swing:
    step = staticmethod(swing(0.0))


def swing_validation(outputs: Any = (0,), **parts: Any) -> Validation:
    """Return the validation of a model without friction, under PID control."""
    width = None if outputs is None else 1
    system = systems.Simulated(swing(0.4), vectorized=True)
    return Validation(
        **{
            "space": TaskSpace(goal=(-1.0, 1.0, "rad")),
            "task": lambda p: Task([0.2, 0.0], goal=[p.goal, 0.0][:width], horizon=H, dt=DT),
            "system": system if outputs is None else systems.WithOutputs(system, outputs),
            "model": Swing(),
            "synthesizer": controllers.PID(3.0, 1.0, 1.0),
            "distance": distances.MaximumDeviation(components=(0,)),
            "outputs": outputs,
            **parts,
        }
    )
