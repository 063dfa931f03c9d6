"""
Comparison: two controllers on one system
=========================================

Two linear quadratic regulators are designed on one model of a cart. The model does not have the drag of the cart. With
which of them does the cart differ less from the prediction, at worst and on average?
"""

import numpy as np

import ctxval
from ctxval import Labels, Task, TaskSpace, Validation, controllers, distances, models, systems


def plant(x, u):
    """Return the next state of the cart, with its drag."""
    drag = 0.3 * x[..., 1] * np.abs(x[..., 1])
    return np.stack([x[..., 0] + 0.05 * x[..., 1], x[..., 1] + 0.05 * (u[..., 0] - drag)], axis=-1)


def cart(synthesizer):
    """Return the validation with a synthesizer."""
    return Validation(
        space=TaskSpace(goal=(-2.0, 2.0, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=60, dt=0.05),
        system=systems.Simulated(plant, vectorized=True),
        model=models.Linear([[1, 0.05], [0, 1]], [[0], [0.05]]),
        synthesizer=synthesizer,
        distance=distances.WholeTrajectory(norm=np.inf, components=[0]),
        labels=Labels(units="m"),
    )


candidates = {"gentle": cart(controllers.LQR([1, 1], [1])), "stiff": cart(controllers.LQR([100, 1], [0.1]))}
result = ctxval.compare(candidates, question="both", budget=60, confidence=0.95)
for pair in result.pairs:
    print(f"{pair.question}: {pair.reason}")

# %%
# The truths are known here, because the system is a simulation.
for name, validation in candidates.items():
    distance = validation.distances(validation.space.grid(1001))
    print(f"{name}: d* = {distance.max():.4f} m, expected distance {distance.mean():.4f} m")
