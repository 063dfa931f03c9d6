"""
Robotic arm: two task parameters
================================

An arm with two joints in MuJoCo, and a linear model that was learned from random torques. The arm reaches for a point
on a table: the task has two parameters.
"""

from matplotlib import pyplot

from ctxval import Campaign, cases, searches

experiment = cases.by_name("arm", seed=0, model="linear")
campaign = Campaign(experiment.validation, search=searches.GPUCB(), seed=0).run(16)
print(campaign.worst.parameters, campaign.worst.distance)

# %%
# With two task parameters a map shows where the model is wrong. The largest distance is at an edge of the table.
points = [trial.parameters for trial in campaign.completed]
figure, axes = pyplot.subplots(figsize=(5, 3.6), layout="constrained")
drawn = axes.scatter(
    [point["y"] for point in points],
    [point["z"] for point in points],
    c=[trial.distance for trial in campaign.completed],
    cmap="viridis",
    edgecolors="black",
    s=70,
)
axes.plot(campaign.worst.parameters["y"], campaign.worst.parameters["z"], "*", color="#D55E00", markersize=16)
axes.set(xlabel="y [m]", ylabel="z [m]", ylim=(-0.11, 0.11))
figure.colorbar(drawn, label="distance [m]")
pyplot.show()

# %%
# The worst task: the trajectories of the model and of the arm under the same controller.
model, system = campaign.trajectories(campaign.worst)
figure, axes = pyplot.subplots(layout="constrained")
axes.plot(*model.states[:, 4:].T, "--", label="model")
axes.plot(*system.states[:, 4:].T, label="arm")
axes.set(xlabel="y [m]", ylabel="z [m]")
axes.legend()
pyplot.show()
