"""What a suggestion of `auto` costs with many trials, as a ratio in one run: 1,000 trials of 100 steps against 50.

There are two systems. On the first one, the dynamics are learned and the search follows their prediction. On the second
one, no dynamics can be learned, so the search compares its prediction with the others and ends at the distances alone.
CPU time counts, and the first suggestion of a process is apart: it reads the trajectories.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from ctxval import (
    Campaign,
    Store,
    Task,
    TaskSpace,
    Trial,
    Validation,
    controllers,
    distances,
    models,
    searches,
    systems,
)
from ctxval._util.arrays import Array
from landed import Ratio, add_store_option

FEW, MANY = 50, 1000
STEPS, DT = 100, 0.05
SUGGESTIONS = 5
MOST = 2.0
"""The ratio that is asked for."""


def cart(x: Array, u: Array) -> Array:
    """Return the next state of a cart with drag and dry friction, which the model does not have."""
    speed = x[..., 1]
    friction = 0.3 * speed * np.abs(speed) + 0.5 * np.tanh(5 * speed)
    return np.stack([x[..., 0] + DT * speed, speed + DT * (u[..., 0] - friction)], axis=-1)


def rough_cart(x: Array, u: Array) -> Array:
    """Return the next state of a cart on ground that is too rough to be learned."""
    return cart(x, u) + 0.01 * np.sin(1e3 * (x.sum(axis=-1) + u.sum(axis=-1)))[..., None]


SYSTEMS = {"smooth": cart, "rough": rough_cart}


def validation(system: str) -> Validation:
    model = models.Linear([[1, DT], [0, 1]], [[0], [DT]])
    return Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m"), speed=(-1.0, 1.0, "m/s")),
        task=lambda p: Task(
            np.stack([0 * p.speed, p.speed], axis=-1),
            goal=np.stack([p.goal, 0 * p.goal], axis=-1),
            horizon=STEPS,
            dt=DT,
        ),
        system=systems.Simulated(SYSTEMS[system], vectorized=True),
        model=model,
        synthesizer=controllers.LQR([10.0, 1.0], [0.1], limits=4.0),
        distance=distances.FinalState(),
    )


def fill(path: Path, system: str, count: int) -> None:
    """Write a store of executed trials, in one transaction."""
    parts = validation(system)
    store: Store = Campaign(parts, search=searches.Auto("thorough"), store=path).store
    new = []
    for number, unit_point in enumerate(np.random.default_rng(0).random((count, 2))):
        point = parts.space.from_unit(unit_point)
        outcome, names = parts.outcome(point), parts.space.describe_point(point)
        distance = float(outcome.distance)
        trial = Trial(number, "acquisition", "completed", unit_point, names, 1, True, distance, seconds=1.0)
        new.append((trial, outcome.plan.model_trajectory, outcome.system_trajectory))
    store.add(new)
    store.close()


def suggestion_seconds(path: Path, system: str) -> list[float]:
    """Return the CPU seconds of suggestions, one after the other, each with its execution of S."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(shutil.copy(path, folder))
        campaign = Campaign(validation(system), search=searches.Auto("thorough"), store=copy)
        seconds = []
        for _ in range(SUGGESTIONS):
            started = time.process_time()
            campaign.run(campaign.executions + 1, explore=True, progress=False)
            seconds.append(time.process_time() - started)
        campaign.store.close()
    return seconds


def ratio(folder: Path, system: str) -> Ratio:
    """Return the CPU time of suggestions with many trials beside that with few."""
    of: dict[int, list[float]] = {}
    for count in (FEW, MANY):
        path = folder / f"{system}-{count}.sqlite"
        fill(path, system, count)
        first, *of[count] = suggestion_seconds(path, system)
        median = statistics.median(of[count])
        print(f"{system}, {count} trials of {STEPS} steps: {median:.2f} s of CPU, the first one {first:.2f} s")
    return Ratio("bench_suggestion", f"{system} dynamics", of[MANY], of[FEW], most=MOST)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_store_option(parser)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for system in SYSTEMS:
            ratio(Path(folder), system).tell(options.store)


if __name__ == "__main__":
    main()
