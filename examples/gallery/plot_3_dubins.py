"""
Dubins car: eleven task parameters
==================================

A car follows a reference of ten sine waves. Its linear model is learned from single steps. The task has the end point
of the reference and ten amplitudes as parameters.
"""

from matplotlib import pyplot

from ctxval import Campaign, cases, plot, searches

experiment = cases.by_name("dubins", seed=0)
campaign = Campaign(experiment.validation, search=searches.Auto(thinking="fast"), seed=0).run(10, explore=True)
print(campaign.worst.parameters, campaign.worst.distance)

# %%
# With eleven parameters the convergence is the most informative plot.
plot.convergence(campaign)
pyplot.show()

# %%
# The worst task. The model and the car get the same controller.
plot.worst_trajectories(campaign)
pyplot.show()
