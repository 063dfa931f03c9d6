"""The whole story: logs, replay, three executions, falsified, refine, validated, report.

The robot is a boat. Its logs have gentle turns only, so its model does not know the drag of fast ones.
"""

import tempfile
from pathlib import Path

import numpy as np

import ctxval
from ctxval import controllers, distances, models, report, searches, systems
from ctxval.data import read_recordings
from ctxval.studies.replay import replay

DT, THRESHOLD = 0.1, 0.1  # s, rad


def boat(x, u):
    """Return the next heading [rad] and turn rate [rad/s] under the torque of the rudder [N m]."""
    rate = x[..., 1]
    change = 0.8 * u[..., 0] - 0.3 * rate - 0.5 * rate * np.abs(rate)
    return np.stack([x[..., 0] + DT * rate, rate + DT * change], axis=-1)


def record(path, seed):
    """Write what the rig records of gentle turns; the columns are x0, x1 and u0."""
    rng = np.random.default_rng(seed)
    states, inputs = [np.zeros(2)], np.repeat(0.1 * rng.normal(size=(20, 1)), 5, axis=0)
    for u in inputs:
        states.append(boat(states[-1], u))
    ctxval.Trajectory(DT * np.arange(101), np.array(states), inputs).to_csv(path)


with tempfile.TemporaryDirectory() as folder:
    for seed in range(6):
        record(Path(folder, f"run{seed}.csv"), seed)
    logs = read_recordings([folder])
    model = models.Linear.fit(logs.transitions(range(4))[0])
    errors = [one.relative for one in replay(model, logs).errors if one.state == "x1" and one.steps == 1]
    print(f"Replay: the error of the rate is {100 * errors[0]:.1f} % of its change, on logs not learned from.")

    validation = ctxval.Validation(
        space=ctxval.TaskSpace(goal=(0.3, 2.5, "rad")),
        task=lambda p: ctxval.Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=40, dt=DT),
        system=systems.Simulated(boat, vectorized=True),
        model=model,
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=[0]),
    )
    search = searches.by_name("auto", thinking="fast")
    campaign = ctxval.Campaign(validation, search=search, store=Path(folder, "boat.sqlite")).run(3)
    print(f"Three executions: {campaign.verdict(THRESHOLD)}")
    found = ctxval.refine(campaign, THRESHOLD, budget=25)
    print(found.text, found.ended, found.statement, "", "Residual of one step:", found.residual.text, sep="\n")
    page = report.write(found.last.campaign, Path(folder, "boat.html"), verdict=found.last.verdict)
    print(f"Report: {page.name}, {len(page.read_text()) // 1000} kB")
