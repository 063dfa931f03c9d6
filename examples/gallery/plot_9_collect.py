"""
Collect: data around the tasks
==============================

If recordings do not excite the system enough, and it can be run, random tasks are executed with a signal added to the
inputs. The data then lie where the tasks lead, and the signal tells apart what the controller alone would not.
"""

import numpy as np
from matplotlib import pyplot

from ctxval import Task, TaskSpace, Transitions, Validation, controllers, distances, models, systems
from ctxval.studies.fitting import Excitation

DT = 0.05


def step(x, u):
    """One step of a cart with friction, which the model does not know."""
    return np.stack([x[..., 0] + DT * x[..., 1], x[..., 1] + DT * (u[..., 0] / 1.2 - 0.4 * x[..., 1])], -1)


validation = Validation(
    space=TaskSpace(goal=(0.5, 1.0, "m")),
    task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=100, dt=DT),
    system=systems.Simulated(step, vectorized=True),
    model=models.Linear([[1, DT], [0, 1]], [[0], [DT]]),
    synthesizer=controllers.StationaryLQR([4.0, 2.0], [1.0], limits=4.0),
    distance=distances.FinalState(norm=2, components=[0]),
)
tasks = validation.space.iid(6, np.random.default_rng(0))
plain = [validation.outcome(task).system_trajectory for task in tasks]
collect = Excitation(validation, "multisine", amplitude=1.0, seed=0)
excited = [collect.run(number) for number in range(6)]

# %%
# Six executions of each kind. Without the signal the cart soon stands at its goal, and its force follows from the state
# by the feedback of the controller.
figure, plots = pyplot.subplots(1, 2, figsize=(7.6, 3.2), layout="constrained", sharex=True)
for runs, name, color, marker in ((excited, "with a signal", "#D55E00", "+"), (plain, "tasks alone", "#0072B2", ".")):
    for k, one in enumerate(runs):
        style = {"color": color, "linestyle": "none", "marker": marker, "markersize": 4, "label": None if k else name}
        plots[0].plot(one.states[:-1, 1], one.inputs[:, 0], **style)
        plots[1].plot(one.states[:, 1], one.states[:, 0], **style)
plots[0].set(xlabel="speed [m/s]", ylabel="force [N]")
plots[1].set(xlabel="speed [m/s]", ylabel="position [m]")
plots[0].legend(fontsize=8)
pyplot.show()

# %%
# How well do the data determine the friction and the effect of the force, if the acceleration is measured with noise?
# The spread is that of least squares over 200 repetitions. With the signal, the effect of the force is known twice as
# well.
truth = np.array([-0.4, 1 / 1.2])
for name, runs in (("tasks alone", plain), ("with a signal", excited)):
    data = Transitions.joined([one.transitions() for one in runs])
    rng, found = np.random.default_rng(1), []
    for _ in range(200):
        change = (data.x_next[:, 1] - data.x[:, 1]) / DT + 0.2 * rng.normal(size=len(data))
        found.append(np.linalg.lstsq(np.column_stack([data.x[:, 1], data.u[:, 0]]), change, rcond=None)[0])
    friction, force = np.std(found, axis=0) / np.abs(truth)
    print(
        f"{name}: standard error of the friction {100 * friction:.1f} %, of the effect of the force {100 * force:.1f} %"
    )
