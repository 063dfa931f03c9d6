"""
Refine a falsified model
========================

A boat turns to a heading. Its model was learned from gentle turns and does not know the drag of fast ones. An execution
falsifies it. The model is corrected with what this execution showed, and validated by executions under its own
controllers.
"""

import numpy as np
from matplotlib import pyplot

from ctxval import (
    Campaign,
    Labels,
    Task,
    TaskSpace,
    Validation,
    controllers,
    distances,
    models,
    refine,
    searches,
    systems,
)

DT, THRESHOLD = 0.1, 0.1  # s, rad


def boat(x, u):
    """Return the next heading [rad] and turn rate [rad/s] under the torque of the rudder."""
    rate = x[..., 1]
    change = 0.8 * u[..., 0] - 0.3 * rate - 0.5 * rate * np.abs(rate)
    return np.stack([x[..., 0] + DT * rate, rate + DT * change], axis=-1)


validation = Validation(
    space=TaskSpace(goal=(0.3, 2.5, "rad")),
    task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=40, dt=DT),
    system=systems.Simulated(boat, vectorized=True),
    model=models.Linear([[1.0, DT], [0.0, 1 - 0.3 * DT]], [[0.0], [0.8 * DT]]),
    synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
    distance=distances.MaximumDeviation(components=[0]),
    labels=Labels(("heading [rad]", "rate [rad/s]"), ("torque [N m]",), "rad"),
)
campaign = Campaign(validation, search=searches.by_name("auto", thinking="fast"))
found = refine(campaign, THRESHOLD, budget=20)
print(found.text)
print(found.statement)

# %%
# The true distance of both models is known here, because the system is simulated. Each model has its own controllers.
goals = np.linspace(0.3, 2.5, 45)
figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
for one, line, mark in ((found.rounds[0], "--", "s"), (found.last, "-", "o")):
    axes.semilogy(
        goals, one.campaign.validation.distances(goals[:, None]), line, color="black", label=f"round {one.number}"
    )
    executed = [(trial.parameters["goal"], trial.distance) for trial in one.campaign.completed]
    axes.semilogy(*zip(*executed, strict=True), mark, color="black", label=f"executed in round {one.number}")
axes.axhline(THRESHOLD, color="tab:orange", label="threshold")
axes.set(xlabel="goal [rad]", ylabel="distance [rad]", title="Distance of the model before and after")
axes.legend()
pyplot.show()

# %%
# A robust controller must assume the residual that is left, in each step. It is measured on executions that the model
# was not learned from, and it is not guaranteed.
print(found.residual.text)
print(found.residual.range_text)
