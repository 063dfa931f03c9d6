"""10,000 trials in one store: how long status, opening a campaign and a suggestion take, in seconds."""

from __future__ import annotations

import json
import subprocess
import sys
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

TRIALS = 10_000


def validation() -> Validation:
    model = models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]])
    return Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m"), speed=(-1.0, 1.0, "m/s")),
        task=lambda p: Task([0, p.speed], goal=[p.goal, 0], horizon=20, dt=0.1),
        system=systems.Simulated(model),
        model=model,
        synthesizer=controllers.LQR([10, 1], [0.1]),
        distance=distances.FinalState(),
    )


def campaign(path: Path) -> Campaign:
    return Campaign(validation(), search=searches.Random(), store=path)


def fill(path: Path, count: int = TRIALS) -> None:
    """Put many completed trials into a store, in one transaction."""
    first = campaign(path)
    plan = first.ask().plan
    first.tell(0, distance=0.0)
    store, space = first.store, first.validation.space
    rng = np.random.default_rng(0)
    with store._transaction():
        for number in range(1, count):
            point = rng.random(2)
            names = space.describe_point(space.from_unit(point))
            store._insert(Trial(number, "iid", "completed", point, names, 1, True, float(rng.random()), seconds=1.0))
            store._write_trajectory(number, "model", plan.model_trajectory)
            store._write_trajectory(number, "system", plan.model_trajectory)
    store.close()


def measure(path: Path) -> dict[str, float]:
    """Return the seconds of each step."""
    started = time.perf_counter()
    store = Store.existing(path)
    trials = len(store.trials())
    opened = time.perf_counter()
    again = campaign(path)
    replayed = time.perf_counter()
    again.ask()
    asked = time.perf_counter()
    command = [sys.executable, "-m", "ctxval.cli", "status", str(path), "--json"]
    subprocess.run(command, check=True, capture_output=True)
    status = time.perf_counter()
    return {
        "trials": trials,
        "open": opened - started,
        "campaign": replayed - opened,
        "suggestion": asked - replayed,
        "status": status - asked,
    }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "many.sqlite"
        fill(path)
        seconds = measure(path)
    print(json.dumps(seconds, indent=1))
    results = Path(__file__).parent / "results" / "store.json"
    results.write_text(json.dumps(seconds, indent=1) + "\n")
    if max(seconds[step] for step in ("open", "campaign", "suggestion", "status")) > 2:
        raise SystemExit("a step takes more than 2 s")
