"""
Inverted pendulum: one task parameter
=====================================

The running example of the paper: a linear model of a pendulum is learned from random torques. An iterative LQR that is
designed on the model swings the rod to a goal angle. At which goal does the pendulum differ most from the prediction?
"""

import numpy as np
from matplotlib import pyplot

from ctxval import Campaign, cases, searches

experiment = cases.by_name("pendulum", seed=1)
campaign = Campaign(experiment.validation, search=searches.GPUCB(), seed=1).run(15)
print(campaign.worst.parameters, campaign.worst.distance)

# %%
# The search has one task parameter, so the surrogate can be drawn over all tasks. The threshold is a line.
space = campaign.validation.space
unit = np.linspace(0, 1, 401)[:, None]
mean, deviation = campaign.surrogate().predict(unit)
goals = space.from_unit(unit)[:, 0]
figure, axes = pyplot.subplots(layout="constrained")
axes.fill_between(goals, np.maximum(mean - 1.96 * deviation, 0), mean + 1.96 * deviation, color="#B0B0B0", alpha=0.6)
axes.plot(goals, mean)
axes.plot(*zip(*[(trial.parameters["goal"], trial.distance) for trial in campaign.completed], strict=True), "ko")
axes.axhline(experiment.threshold, linestyle="-.")
axes.set(xlabel=space.labels[0], ylabel="distance [rad]")
pyplot.show()

# %%
# The true d* is known here, because the system is a simulation: it comes from a dense grid.
truth = experiment.truth()
print(f"largest distance found {campaign.worst.distance:.4f} rad, d* = {truth.distance:.4f} rad")
