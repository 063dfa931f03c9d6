"""Campaigns for tests of reports: small, of each kind that a report distinguishes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from conftest import make_validation
from ctxval import (
    Campaign,
    Labels,
    Store,
    Task,
    TaskSpace,
    Validation,
    controllers,
    distances,
    models,
    searches,
    systems,
)
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.trial_note import TrialNote
from faulty_rig import FaultyRig

HOSTILE = "</script><script>document.title='hacked'</script><img src=x onerror=alert(1)>"
"""A text that would script a page into which it is put as it is."""


def pendulum(store: Path | None = None, executions: int = 9) -> Campaign:
    """Return a campaign with one task parameter."""
    labels = Labels(("angle [rad]", "rate [rad/s]"), ("torque [N m]",), "rad")
    validation = make_validation().with_parts(labels=labels)
    return Campaign(validation, search=searches.GPUCB(), store=store, seed=1, name="pendulum").run(executions)


def plane(dimension: int = 2, executions: int = 10, faults: dict[int, str] | None = None) -> Campaign:
    """Return a campaign with so many task parameters, in which some executions fail."""
    space = TaskSpace(**dict.fromkeys("abcdefgh"[:dimension], (-1.0, 1.0, "m")))
    n = 2
    system = systems.Simulated(models.Linear(0.9 * np.eye(n), np.eye(n)))

    def task(p: object) -> Task:
        points = p.points  # type: ignore[attr-defined]
        return Task(points[..., :n] + 0.3 * points[..., n:].sum(axis=-1, keepdims=True), horizon=5, dt=0.1)

    validation = Validation(
        space=space,
        task=task,
        system=FaultyRig(system, {1: "raise"} if faults is None else faults),
        model=models.Linear(0.8 * np.eye(n), np.eye(n)),
        synthesizer=controllers.LQR([1, 1], [1, 1], limits=0.2),
        distance=distances.FinalState(norm=1),
        labels=Labels(("x [m]", "y [m]"), ("u [N]", "v [N]"), "m"),
    )
    return Campaign(validation, search=searches.Random(), seed=1, name="plane").run(executions)


def hostile_store(path: Path) -> Store:
    """Return a store of which every name and every text is hostile, and whose numbers are extreme."""
    store = Store(path)
    space = {"type": "TaskSpace", HOSTILE: [-1.0, 1.0, HOSTILE], "plain": [0.0, 1.0]}
    parts = {"space": space, "system": HOSTILE, "model": {"type": HOSTILE}, "distance": {"type": HOSTILE}}
    store.describe_first({"name": HOSTILE, "seed": HOSTILE, "search": {"type": HOSTILE}, "validation": parts})
    model = Trajectory(np.arange(4.0), np.zeros((4, 2)), np.zeros((3, 1)))
    values = [1e300, 0.0, 2.0, 3.0]
    for number, value in enumerate(values):
        point = np.array([number / 4, 0.5])
        named = {HOSTILE: float(point[0]), "plain": 0.5}
        note = TrialNote(prediction={"quantiles": HOSTILE})
        trial = Trial(number, "acquisition", "open", point, named, because=HOSTILE, note=note)
        store.add([(trial, model, None)])
        states = np.full((4, 2), 1e200 if number == 0 else float(number))
        ended = replace(trial, state="completed", executed=True, distance=value)
        store.close_trials([(ended, Trajectory(np.arange(4.0), states, np.zeros((3, 1))))])
    last = Trial(4, "manual", "open", np.array([0.9, 0.5]), {HOSTILE: 0.9, "plain": 0.5})
    store.add([(last, model, None)])
    store.close_trials([(replace(last, state="failed", executed=True, failure=HOSTILE), None)])
    store.keep_settings({"experiment": HOSTILE, "search": {"type": HOSTILE}, "options": {HOSTILE: HOSTILE}, "seed": 0})
    return store
