"""
Pendulum with an encoder, noise and a late torque
=================================================

The running example as it would be on a bench. Nothing of this is declared: noise and the delay are learned from the
executions, and the verdict is about nine of ten executions of each task.
"""

import numpy as np
from matplotlib import pyplot

from ctxval import Campaign, cases

experiment = cases.by_name("pendulum-noisy")
campaign = Campaign(experiment.validation, seed=0).run(25, threshold=experiment.threshold)
verdict = campaign.verdict(experiment.threshold)
print(verdict)

# %%
# The dash-dotted lines are the threshold and, if the verdict has one, the bound on the 0.9 quantile in every task.
space = campaign.validation.space
unit = np.linspace(0, 1, 401)[:, None]
mean, deviation = campaign.surrogate().predict(unit)
goals = space.from_unit(unit)[:, 0]
figure, axes = pyplot.subplots(layout="constrained")
axes.fill_between(goals, np.maximum(mean - 1.96 * deviation, 0), mean + 1.96 * deviation, color="#B0B0B0", alpha=0.6)
axes.plot(goals, mean)
axes.plot(*zip(*[(trial.parameters["goal"], trial.distance) for trial in campaign.completed], strict=True), "ko")
for limit in filter(None, (experiment.threshold, verdict.bound)):
    axes.axhline(limit, linestyle="-.")
axes.set(xlabel=space.labels[0], ylabel="distance [rad]")
pyplot.show()
