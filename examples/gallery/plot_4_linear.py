"""
Random linear systems: twenty task parameters
=============================================

The system and the model are random linear systems with ten states. The task has twenty parameters: the initial state
and the goal. The largest distance is known in closed form, so the result can be checked.
"""

import numpy as np
from matplotlib import pyplot

from ctxval import Campaign, cases, searches

experiment = cases.by_name("linear", seed=0, dim=10)
campaign = Campaign(experiment.validation, search=searches.Auto(thinking="fast"), seed=0).run(15, explore=True)
truth = experiment.truth()
print(f"largest distance found {campaign.worst.distance:.4f}, d* = {truth.distance:.4f}")

# %%
# The line is the true d*.
distances = campaign.trials.completed.distances
figure, axes = pyplot.subplots(layout="constrained")
axes.step(campaign.trials.completed.numbers, np.maximum.accumulate(distances), where="post")
axes.plot(campaign.trials.completed.numbers, distances, "ko")
axes.axhline(truth.distance, linestyle=":")
axes.set(xlabel="trial", ylabel="distance")
pyplot.show()
