"""
Dubins car: eleven task parameters
==================================

A car follows a reference of ten sine waves. Its linear model is learned from single steps. The task has the end point
of the reference and ten amplitudes as parameters.
"""

import numpy as np
from matplotlib import pyplot

from ctxval import Campaign, cases, searches

experiment = cases.by_name("dubins", seed=0)
campaign = Campaign(experiment.validation, search=searches.Auto(thinking="fast"), seed=0).run(10, explore=True)
print(campaign.worst.parameters, campaign.worst.distance)

# %%
# With eleven parameters the convergence is the most informative plot.
distances = campaign.trials.completed.distances
figure, axes = pyplot.subplots(layout="constrained")
axes.step(campaign.trials.completed.numbers, np.maximum.accumulate(distances), where="post")
axes.plot(campaign.trials.completed.numbers, distances, "ko")
axes.set(xlabel="trial", ylabel="distance")
pyplot.show()

# %%
# The worst task. The model and the car get the same controller.
model, system = campaign.trajectories(campaign.worst)
figure, axes = pyplot.subplots(layout="constrained")
axes.plot(*model.states[:, :2].T, "--", label="model")
axes.plot(*system.states[:, :2].T, label="car")
axes.set(xlabel="y [m]", ylabel="z [m]")
axes.legend()
pyplot.show()
