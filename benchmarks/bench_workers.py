"""The speed-up of 2 and 8 workers on a system that sleeps for a second, over one worker in the same run."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, searches
from ctxval._util.json_lines import JsonLines
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout

WORKERS = (2, 8)
ROUNDS = 3
"""Executions of each worker."""


class Sleeping:
    """A system whose execution takes a second, of which none is computing."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        time.sleep(self.seconds)
        return rollout(lambda x, u: 0.99 * models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]]).step(x, u), controller, task)


def campaign(seconds: float) -> Campaign:
    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m")),
        task=lambda p: Task([0, 0], goal=[p.goal, 0], horizon=20, dt=0.1),
        system=Sleeping(seconds),
        model=models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]]),
        synthesizer=controllers.LQR([10, 1], [0.1]),
        distance=distances.FinalState(),
    )
    return Campaign(validation, search=searches.Random())


def pace(workers: int, seconds: float) -> float:
    """Return executions per second."""
    running = campaign(seconds)
    started = time.perf_counter()
    running.run(ROUNDS * workers, workers=workers)
    return ROUNDS * workers / (time.perf_counter() - started)


def measure(seconds: float = 1.0) -> dict[int, float]:
    """Return the speed-up over one worker, as a share of the number of workers."""
    alone = pace(1, seconds)
    return {workers: pace(workers, seconds) / alone / workers for workers in WORKERS}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.0)
    shares = measure(parser.parse_args().seconds)
    for workers, share in shares.items():
        print(f"{workers} workers: {share:.3f} of ideal")
    results = JsonLines(Path(__file__).parent / "results" / "workers.jsonl", ("workers",))
    for workers, share in shares.items():
        results.append({"workers": workers, "share_of_ideal": share})
    if min(shares.values()) < 0.9:
        raise SystemExit("below 0.9 of ideal")
