"""
Pendulum with an encoder, noise and a late torque
=================================================

The running example as it would be on a bench. Nothing of this is declared: noise and the delay are learned from the
executions, and the verdict is about nine of ten executions of each task.
"""

from matplotlib import pyplot

from ctxval import Campaign, cases

experiment = cases.by_name("pendulum-noisy")
campaign = Campaign(experiment.validation, seed=0).run(25, threshold=experiment.threshold)
verdict = campaign.verdict(experiment.threshold)
print(verdict)

# %%
# The dash-dotted lines are the threshold and, if the verdict has one, the bound on the 0.9 quantile in every task.
figure, axes = pyplot.subplots(layout="constrained")
axes.plot(*zip(*[(trial.parameters["goal"], trial.distance) for trial in campaign.completed], strict=True), "ko")
for limit in filter(None, (experiment.threshold, verdict.bound)):
    axes.axhline(limit, linestyle="-.")
axes.set(xlabel=campaign.validation.space.labels[0], ylabel="distance [rad]")
pyplot.show()
