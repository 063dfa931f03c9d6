"""
Pendulum with an encoder, noise and a late torque
=================================================

The running example as it would be on a bench. Nothing of this is declared: noise and the delay are learned from the
executions, and the verdict is about nine of ten executions of each task.
"""

from matplotlib import pyplot

from ctxval import Campaign, cases, plot

experiment = cases.by_name("pendulum-noisy")
campaign = Campaign(experiment.validation, seed=0).run(25, threshold=experiment.threshold)
verdict = campaign.verdict(experiment.threshold)
print(verdict)

# %%
# The bound is one on the 0.9 quantile of the distance in every task.
plot.surrogate_slice(campaign, threshold=experiment.threshold, bound=verdict.bound)
pyplot.show()
