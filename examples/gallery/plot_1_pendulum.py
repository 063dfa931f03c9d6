"""
Inverted pendulum: one task parameter
=====================================

The running example of the paper: a linear model of a pendulum is learned from random torques. An iterative LQR that is
designed on the model swings the rod to a goal angle. At which goal does the pendulum differ most from the prediction?
"""

from matplotlib import pyplot

from ctxval import Campaign, cases, plot, searches

experiment = cases.by_name("pendulum", seed=1)
campaign = Campaign(experiment.validation, search=searches.GPUCB(), seed=1).run(15)
print(campaign.worst.parameters, campaign.worst.distance)

# %%
# The search has one task parameter, so the surrogate can be drawn over all tasks. The threshold is a line.
plot.surrogate_slice(campaign, threshold=experiment.threshold)
pyplot.show()

# %%
# The true d* is known here, because the system is a simulation: it comes from a dense grid.
truth = experiment.truth()
print(f"largest distance found {campaign.worst.distance:.4f} rad, d* = {truth.distance:.4f} rad")
