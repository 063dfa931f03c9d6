"""
Aspect 1: does the model itself complete the tasks?
===================================================

The paper's Remark 1 asks two questions. A campaign answers the second one: does the system behave like its model? The
first one is whether the model itself completes the tasks, and simulation alone answers it. The arm reaches for points
on a table, and iterative LQR designs its controllers on a small network.
"""

from matplotlib import pyplot

from ctxval import aspect1, cases

experiment = cases.by_name("arm", seed=0, model="fnn")
report = aspect1.check(experiment.validation, threshold=0.05, tasks=80)
print(f"{report.exceeding} of {len(report.simulated)} tasks end more than 0.05 m from the goal, on the model itself")
print(f"worst: {report.worst.parameters}, {report.worst.error:.3f} m")
print(f"{len(report.not_converged)} of {report.designs} designs did not converge")
print(f"{report.flips.flipped} of {report.flips.pairs} pairs of neighbouring tasks have very different controllers")

# %%
# Each mark is a simulated task. The model ends near its goal on the right side of the table, and far from it on the
# left side. Where the design did not converge (crosses), the controllers are to be improved before the model is.
figure, axes = pyplot.subplots(figsize=(5.4, 3.8), layout="constrained")
where = [one.parameters for one in report.simulated]
drawn = axes.scatter(
    [point["y"] for point in where],
    [point["z"] for point in where],
    c=[one.error for one in report.simulated],
    cmap="viridis",
    edgecolors="black",
    s=60,
)
axes.plot(
    [point["y"] for point in report.not_converged],
    [point["z"] for point in report.not_converged],
    "x",
    color="#D55E00",
    markersize=9,
    markeredgewidth=2,
    label="design did not converge",
)
axes.set(xlabel="y [m]", ylabel="z [m]")
axes.legend(loc="lower left", bbox_to_anchor=(0, 1), fontsize=8)
figure.colorbar(drawn, label="distance of the model from its goal [m]")
pyplot.show()
