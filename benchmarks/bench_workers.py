"""How busy workers are: local processes whose executions sleep for a second, and Dask workers with 50 ms.

The speed-up of local processes is measured over one worker in the same run. The share of the time in which Dask workers
execute is shown beside that of the same executions without a campaign, all submitted at once.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from distributed import Client

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent / "tests"), str(HERE)]

import rig_cluster  # noqa: E402
from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, searches  # noqa: E402
from ctxval.campaign.workers import execute_task  # noqa: E402
from ctxval.core.controller import Controller  # noqa: E402
from ctxval.core.rollout import rollout  # noqa: E402
from json_lines import JsonLines  # noqa: E402

WORKERS = (2, 8)
ROUNDS = 3
"""Executions of each worker."""

DASK_WORKERS, DASK_EXECUTIONS, DASK_SECONDS = 2, 200, 0.05


class Sleeping:
    """A system whose execution takes a second, of which none is computing."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        time.sleep(self.seconds)
        return rollout(lambda x, u: 0.99 * models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]]).step(x, u), controller, task)


def campaign(seconds: float, store: Path | None = None) -> Campaign:
    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m")),
        task=lambda p: Task([0, 0], goal=[p.goal, 0], horizon=20, dt=0.1),
        system=Sleeping(seconds),
        model=models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]]),
        synthesizer=controllers.LQR([10, 1], [0.1]),
        distance=distances.FinalState(),
    )
    return Campaign(validation, search=searches.Random(), store=store)


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


def busy_shares(folder: Path) -> dict[str, float]:
    """Return the share of the time in which Dask workers execute: in a search, in an audit, and without a campaign."""
    rig_cluster.ENVIRONMENT["PYTHONPATH"] += os.pathsep + str(HERE)  # the workers import this module
    total, shares = DASK_WORKERS * 1.0, dict[str, float]()
    with rig_cluster.cluster(folder / "cluster", DASK_WORKERS) as running, Client(running.address) as client:
        executor = client.get_executor(pure=False)
        options = {"executor": executor, "workers": DASK_WORKERS}
        campaign(DASK_SECONDS).run(4 * DASK_WORKERS, **options)  # the workers import what they need
        for name in ("random search", "audit"):
            one = campaign(DASK_SECONDS, folder / f"{name}.sqlite")
            started = time.perf_counter()
            (one.run if name == "random search" else one.audit)(DASK_EXECUTIONS, **options)
            seconds = time.perf_counter() - started
            shares[name] = sum(trial.seconds for trial in one.trials) / (total * seconds)
        plan = one.validation.plan([1.0])
        started = time.perf_counter()
        arguments = (execute_task, one.validation.system, plan.controller, plan.task)
        futures = [executor.submit(*arguments) for _ in range(DASK_EXECUTIONS)]
        executed = sum(future.result().seconds for future in futures)
        shares["without a campaign"] = executed / (total * (time.perf_counter() - started))
    return shares


if __name__ == "__main__":
    import bench_workers  # Dask workers find the system there, not in this script

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.0)
    shares = measure(parser.parse_args().seconds)
    for workers, share in shares.items():
        print(f"{workers} workers: {share:.3f} of ideal")
    results = JsonLines(HERE / "results" / "workers.jsonl", ("workers",))
    for workers, share in shares.items():
        results.append({"workers": workers, "share_of_ideal": share})
    with tempfile.TemporaryDirectory() as folder:
        busy = bench_workers.busy_shares(Path(folder))
    for name, share in busy.items():
        print(f"{DASK_WORKERS} Dask workers, executions of {DASK_SECONDS * 1e3:g} ms, {name}: busy {share:.3f}")
    if min(shares.values()) < 0.9 or min(busy.values()) < 0.9 * busy["without a campaign"]:
        raise SystemExit("below 0.9 of ideal, or of what Dask reaches without a campaign")
