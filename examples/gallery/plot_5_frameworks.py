"""
Why in closed loop: four ways to compare a model with its system
================================================================

Example 1 of the paper. A model can be compared with its system in open loop, under the worst torques that anybody could
apply, or in closed loop, under the controller that is designed on the model. It can be compared by whole trajectories
or by final states. Only the task tells which of these numbers matters.
"""

import numpy as np
from matplotlib import pyplot

from ctxval.paper.reproduce.frameworks import BOUND, frameworks

found = frameworks(seed=0, per_axis=301, restarts=8)
print(f"open loop, torques up to {BOUND} N m: {found['oldt'][0]:.3g} and {found['olcd'][0]:.3g}")
print(f"closed loop, worst goal: {max(found['ccdt']):.3g} and {max(found['custom']):.3g}")

# %%
# In closed loop the distance depends on the goal. The goal of the largest difference between whole trajectories is not
# the goal of the largest difference between final states: the distance should be chosen for the task.
figure, axes = pyplot.subplots(figsize=(6.4, 3.6), layout="constrained")
axes.plot(found["goals"], found["ccdt"], label="whole trajectories", color="#D55E00", linestyle="--")
axes.plot(found["goals"], found["custom"], label="final states", color="#0072B2")
worst = [found["goals"][np.argmax(found[name])] for name in ("ccdt", "custom")]
axes.axvline(worst[0], color="#D55E00", linestyle=":", linewidth=1)
axes.axvline(worst[1], color="#0072B2", linestyle=":", linewidth=1)
axes.set(xlabel="goal [rad]", ylabel="distance", ylim=(0, None))
axes.legend()
pyplot.show()
print(f"worst goals: {worst[0]:.2f} rad and {worst[1]:.2f} rad")
