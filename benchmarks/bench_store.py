"""10,000 trials in one store: CPU seconds of status, of opening a campaign and of a suggestion, for each search.

And those of a suggestion of the scalar search in 20 dimensions, for 1,000 and for 10,000 trials. Other programs on the
machine change CPU seconds little.
"""

from __future__ import annotations

import resource
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
    Trajectory,
    Trial,
    Validation,
    controllers,
    models,
    systems,
)
from json_lines import JsonLines
from named_searches import search_named

TRIALS = 10_000
SEARCHES = ("random", "gp-ucb", "scalar")
MOST = 2.0
SUGGESTIONS = 8
"""The scalar search takes turns of several kinds; the slowest suggestion counts."""


def validation() -> Validation:
    model = models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]])
    return Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m"), speed=(-1.0, 1.0, "m/s")),
        task=lambda p: Task(
            np.stack([0 * p.speed, p.speed], axis=-1),
            goal=np.stack([p.goal, 0 * p.goal], axis=-1),
            horizon=20,
            dt=0.1,
        ),
        system=systems.Simulated(model),
        model=model,
        synthesizer=controllers.LQR([10, 1], [0.1]),
        distance=landscape,
    )


def landscape(model: Trajectory, system: Trajectory, task: Task) -> np.ndarray:
    """Return a distance that depends on the task alone, so that many trials can be stored without an execution."""
    return height(np.stack([(task.goal[..., 0] - 0.5) / 1.5, (task.initial_state[..., 1] + 1.0) / 2.0], axis=-1))


def campaign(path: Path, search: str) -> Campaign:
    return Campaign(validation(), search=search_named(search), store=path)


def height(points: np.ndarray) -> np.ndarray:
    """Return a smooth distance with a flank for the searches to climb, at points ``(..., d)``."""
    flank = 0.3 * np.abs(np.sin(7 * points[..., 0]) * points[..., -1])
    return np.asarray(np.exp(-4 * ((points - 0.7) ** 2).mean(axis=-1)) + flank)


def fill(path: Path, search: str, count: int = TRIALS) -> None:
    """Put many completed trials into a store, in one transaction."""
    first = campaign(path, search)
    asked = first.ask()
    first.tell(asked, distance=float(height(asked.trial.unit_point)))
    store, space = first.store, first.validation.space
    points = np.random.default_rng(0).random((count, 2))
    plans, values = first.validation.plans(space.from_unit(points)), height(points)
    new = []
    for number in range(1, count):
        point, trajectory = points[number], plans[number].model_trajectory
        names = space.describe_point(space.from_unit(point))
        trial = Trial(number, "acquisition", "completed", point, names, 1, True, float(values[number]), seconds=1.0)
        new.append((trial, trajectory, trajectory))
    store.add(new)
    store.close()


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and of the child processes that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def measure(path: Path, search: str) -> dict[str, float]:
    """Return the CPU seconds of each step."""
    started = cpu_seconds()
    store = Store.existing(path)
    assert len(store.trials()) == TRIALS
    store.close()
    opened = cpu_seconds()
    again = campaign(path, search)
    replayed = cpu_seconds()
    suggestions = []
    for _ in range(SUGGESTIONS):
        began = cpu_seconds()
        asked = again.ask()
        suggestions.append(cpu_seconds() - began)
        again.tell(asked, distance=float(height(asked.trial.unit_point)))
    again.store.close()
    began = cpu_seconds()
    command = [sys.executable, "-m", "ctxval", "status", str(path), "--json"]
    subprocess.run(command, check=True, capture_output=True)
    status = cpu_seconds() - began
    return {
        "open": opened - started,
        "campaign": replayed - opened,
        "suggestion": float(np.median(suggestions)),
        "slowest suggestion": max(suggestions),
        "status": status,
    }


def suggestions_alone(count: int, dimension: int) -> dict[str, float]:
    """Return the CPU seconds of the scalar search's suggestions after so many values, without a store."""
    search = search_named("scalar")
    search.reset(dimension, 0)
    points = np.random.default_rng(0).random((count, dimension))
    search.tell(points, height(points))
    seconds = []
    for _ in range(SUGGESTIONS):
        began = cpu_seconds()
        point = search.ask(1)
        seconds.append(cpu_seconds() - began)
        search.tell(point, height(point))
    return {"suggestion": float(np.median(seconds)), "slowest suggestion": max(seconds)}


def main() -> None:
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for search in SEARCHES:
            path = Path(folder) / f"{search}.sqlite"
            fill(path, search)
            results[f"{search}, {TRIALS} trials in 2-D"] = measure(path, search)
    for count in (1000, TRIALS):
        results[f"scalar alone, {count} values in 20-D"] = suggestions_alone(count, 20)
    slow = [f"{what}: {step}" for what, steps in results.items() for step, taken in steps.items() if taken > MOST]
    stored = JsonLines(Path(__file__).parent / "results" / "store.jsonl", ("what",))
    for what, measured in results.items():
        print(what, measured)
        stored.append({"what": what, **measured})
    if slow:
        raise SystemExit(f"more than {MOST:g} CPU s: {'; '.join(slow)}")


if __name__ == "__main__":
    main()
