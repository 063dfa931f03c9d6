"""
Fit: models from recordings
===========================

A linear model, a network, Gaussian processes and the parameters of a function of one's own are learned from the same
recordings. Their errors are those of recordings that none of them was learned from.
"""

import numpy as np
from matplotlib import pyplot

from ctxval.data import recordings_of
from ctxval.data.log import MemoryTable
from ctxval.studies.fitting import fit

DT = 0.05


def step(x, u, theta):
    """One step of a cart with a mass and a quadratic drag."""
    mass, drag = theta
    force = u[..., 0] - drag * x[..., 1] * np.abs(x[..., 1])
    return np.stack([x[..., 0] + DT * x[..., 1], x[..., 1] + DT * force / mass], -1)


logs = []
for number in range(10):
    rng = np.random.default_rng(number)
    states, forces = [rng.normal(size=2)], np.repeat(4 * rng.normal(size=30), 5)[:, None]
    for force in forces:
        states.append(step(states[-1], force, (1.2, 0.4)) + 0.0005 * rng.normal(size=2))
    rows = np.append(forces, [[np.nan]], axis=0)  # there is no force after the last state
    logs.append(MemoryTable(f"run {number}", {"t": DT * np.arange(len(states)), "x": np.array(states), "u": rows}))

bounds = {"mass": (0.5, 2.0), "drag": (0.0, 1.0)}
kinds = ["linear", "network", "gaussian-process", "parameters"]
report = fit(recordings_of(logs), kinds, step=step, bounds=bounds, vectorized=True, steps=(1, 5, 20, 60))
for parameter in report.fitted[0].parameters:
    print(f"{parameter.name} is between {parameter.low:.4f} and {parameter.high:.4f} with confidence 0.95")

# %%
# The right function with two parameters predicts best. Without it, the other models learn the drag from the recordings,
# and the linear one cannot.
figure, axes = pyplot.subplots(figsize=(5.6, 3.4), layout="constrained")
for one, marker in zip(report.fitted, "os^D", strict=True):
    errors = [error for error in one.errors if error.state == "x1"]
    axes.loglog([error.steps for error in errors], [error.rms for error in errors], f"{marker}-", label=one.kind)
axes.set(xlabel="steps", ylabel="held-out error of the speed [m/s]")
axes.legend(fontsize=8)
pyplot.show()
