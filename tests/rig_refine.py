"""A cart with friction that its model does not know: ``python rig_refine.py STORE`` refines it, to be killed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Campaign, Task, TaskSpace, Transitions, Validation, controllers, distances, models, searches, systems
from ctxval.certificates import Automatic, CertificateOptions
from ctxval.studies.refinement import Refinement, refine

THRESHOLD, BUDGET = 0.05, 14
FEW_TESTS = CertificateOptions(Automatic(tests=2))
FIRST = models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]])


def cart(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the next position and speed of a cart with viscous friction and drag."""
    speed = x[..., 1]
    force = u[..., 0] - 0.5 * speed - 0.3 * speed * np.abs(speed)
    return np.stack([x[..., 0] + 0.1 * speed, speed + 0.1 * force], axis=-1)


def make_cart(model: Any = FIRST, system: Any = None) -> Validation:
    return Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=30, dt=0.1),
        system=systems.Simulated(cart, vectorized=True) if system is None else system,
        model=model,
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=[0]),
    )


def memory(data: Transitions) -> models.Model:
    """Return a model that is exact at what it has seen, and as before everywhere else."""
    seen = np.concatenate([data.x, data.u], axis=1)

    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        z = np.concatenate([x, u], axis=-1)
        gaps = np.abs(z[..., None, :] - seen).max(axis=-1)
        nearest = gaps.argmin(axis=-1)
        known = np.take_along_axis(gaps, nearest[..., None], axis=-1) < 1e-9
        return np.where(known, data.x_next[nearest], FIRST.step(x, u))

    return models.Function(step, vectorized=True)


def campaign(store: Path | None = None, **parts: Any) -> Campaign:
    return Campaign(make_cart(**parts), search=searches.by_name("auto", thinking="fast"), store=store, seed=3)


def refined(store: Path | None = None, method: Any = "residual", **parts: Any) -> Refinement:
    return refine(campaign(store, **parts), THRESHOLD, BUDGET, method=method, certificate=FEW_TESTS)


if __name__ == "__main__":
    import small_ctxval  # noqa: F401  # few draws and few closed loops, as in the process that compares

    made = campaign(Path(sys.argv[1]))
    print("ready", flush=True)
    refine(made, THRESHOLD, BUDGET, certificate=FEW_TESTS)
