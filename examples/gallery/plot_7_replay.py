"""
Replay: recordings on a model
=============================

Recordings of a pendulum in MCAP, and a linear model of it. Nothing is executed: the recordings show how far the model
predicts, where it errs, and what a better model could explain.
"""

import json
import tempfile
from pathlib import Path

import numpy as np
from matplotlib import pyplot
from mcap.writer import Writer

from ctxval import models, systems
from ctxval.data import LogMapping, read_recordings
from ctxval.studies.replay import replay

DT = 0.02
step = systems.rk4(lambda x, u: np.stack([x[..., 1], -9.8 * np.sin(x[..., 0]) - 0.3 * x[..., 1] + u[..., 0]], -1), DT)


def record(path: Path, seed: int) -> None:
    """Write one run under random torques as messages in JSON."""
    rng = np.random.default_rng(seed)
    x = np.array([rng.uniform(-1.5, 1.5), 0.0])
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        topic = writer.register_channel("/joint", "json", writer.register_schema("joint", "jsonschema", b"{}"))
        for k, torque in enumerate(np.repeat(2 * rng.normal(size=40), 8)):
            message = {"angle": x[0], "rate": x[1], "torque": torque}
            writer.add_message(topic, 20_000_000 * k, json.dumps(message).encode(), 20_000_000 * k)
            x = step(x, np.array([torque]))
        writer.finish()


fields = {
    "states": {"angle": {"path": "/joint.angle", "unit": "rad"}, "rate": {"path": "/joint.rate", "unit": "rad/s"}},
    "inputs": {"torque": "/joint.torque"},
}
with tempfile.TemporaryDirectory() as folder:
    for seed in range(10):
        record(Path(folder, f"run{seed}.mcap"), seed)
    recordings = read_recordings([folder], LogMapping.from_table(fields))
model = models.Linear([[1, DT], [-9.8 * DT, 1]], [[0], [DT]])  # the pendulum around the bottom, without friction
report = replay(model, recordings)
print(*report.insights, sep="\n")

# %%
# The error of the prediction grows with the number of steps, differently in each recording, and reaches that of a model
# that predicts no change.
figure, plots = pyplot.subplots(1, 2, figsize=(7.6, 3.2), layout="constrained")
for axes, state in zip(plots, report.data.states, strict=True):
    found = [one for one in report.errors if one.state == state]
    steps, rms = [one.steps for one in found], np.array([one.rms for one in found])
    spread = [rms - [one.lowest for one in found], [one.highest for one in found] - rms]
    axes.errorbar(steps, rms, yerr=spread, fmt="o-", color="#0072B2", capsize=3, label="error, range of recordings")
    axes.plot(steps, [one.change for one in found], "--", color="#D55E00", label="change")
    axes.set(xlabel="steps", ylabel=f"{state} [{found[0].unit}]", ylim=(0, None))
plots[0].legend(fontsize=8)
pyplot.show()

# %%
# The one-step error is largest where the sine is far from linear.
regions = [one for one in report.regions if one.variable == "angle"]
figure, axes = pyplot.subplots(figsize=(5, 3), layout="constrained")
axes.stairs(
    [one.ratio for one in regions], [regions[0].low, *(one.high for one in regions)], fill=True, color="#56B4E9"
)
axes.axhline(1, color="black", linestyle=":", linewidth=1)
axes.set(xlabel="angle [rad]", ylabel="error / average")
pyplot.show()
