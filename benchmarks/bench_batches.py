"""What it saves to execute independent tasks together: random searches, audits and recordings of a MuJoCo model.

Each is run with batches and one by one, in turns, on one thread; run it with OMP_NUM_THREADS=1. The ratios are those of
the medians in one run: CPU time, and the time with the disk. The last column compares the CPU time with batches to that
of the bare mj_step calls.
"""

from __future__ import annotations

import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from bench_mujoco import CART, bare_seconds
from ctxval import (
    Campaign,
    Task,
    TaskSpace,
    Trajectory,
    Validation,
    controllers,
    distances,
    models,
    searches,
    systems,
)
from ctxval.campaign import workers
from ctxval.campaign.goals_of_model import GoalWarning
from ctxval.paper.cases import arm
from json_lines import JsonLines

EXECUTIONS, ROUNDS, SUBSTEPS, DT = 256, 3, 5, 0.05
LEAST = 1.5
"""Of the CPU time, for the cart; the designs of the arm, each an iLQR, take most of its time."""


def cart() -> Validation:
    A, B = np.eye(4), np.array([[0.0], [0.0], [DT], [-2 * DT]])
    A[0, 2] = A[1, 3] = DT
    return Validation(
        space=TaskSpace(goal=(0.2, 1.0, "m")),
        task=lambda p: Task(np.zeros(4), goal=[p.goal, 0, 0, 0], horizon=100, dt=DT),
        system=systems.MuJoCo(CART, substeps=SUBSTEPS),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([1, 1, 0.1, 0.1], [1], limits=5),
        distance=distances.FinalState(),
    )


def search(validation: Validation, store: Path) -> Campaign:
    return Campaign(validation, search=searches.Random(), store=store).run(EXECUTIONS)


def audit(validation: Validation, store: Path) -> Campaign:
    return Campaign(validation, search=searches.Random(), store=store).audit(EXECUTIONS)


@contextmanager
def at_most(batch: int) -> Iterator[None]:
    before, workers._BATCH = workers._BATCH, batch
    try:
        yield
    finally:
        workers._BATCH = before


def seconds_of(job: Callable[[Validation, Path], object], validation: Validation) -> tuple[float, float]:
    """Return the CPU time and the time that a job takes."""
    with tempfile.TemporaryDirectory() as folder:
        cpu, begun = time.process_time(), time.perf_counter()
        job(validation, Path(folder) / "result")
        return time.process_time() - cpu, time.perf_counter() - begun


def measure(job: Callable[[Validation, Path], object], validation: Validation, bare: float) -> dict[str, float]:
    together, alone = list[tuple[float, float]](), list[tuple[float, float]]()
    for _ in range(ROUNDS):
        together.append(seconds_of(job, validation))
        with at_most(1):
            alone.append(seconds_of(job, validation))
    (cpu, whole), (cpu_alone, whole_alone) = (
        [statistics.median(column) for column in zip(*rows, strict=True)] for rows in (together, alone)
    )
    return {"cpu": cpu_alone / cpu, "time": whole_alone / whole, "ms": 1e3 * cpu / EXECUTIONS, "bare": cpu / bare}


def main() -> None:
    results = JsonLines(Path(__file__).parent / "results" / "batches.jsonl", ("system", "job"))
    short = list[str]()
    cases = {"cart": (cart(), CART, SUBSTEPS), "arm": (arm.experiment().validation, arm.MJCF, arm.Settings().substeps)}
    for name, (validation, xml, substeps) in cases.items():
        with tempfile.TemporaryDirectory() as folder:
            done = search(validation, Path(folder) / "first")  # imports, and what the physics alone takes
            loops = [loop for trial in done.trials if (loop := done.trajectories(trial)[1]) is not None]
            times, states, inputs = (
                np.stack([getattr(loop, part) for loop in loops]) for part in ("times", "states", "inputs")
            )
            executed = Trajectory(times[0], states, inputs)
            bare = statistics.median(bare_seconds(xml, substeps, executed) for _ in range(ROUNDS))
        for job in (search, audit):
            measured = measure(job, validation, bare)
            print(
                f"{name}, {job.__name__} of {EXECUTIONS}: {measured['ms']:.2f} ms of CPU time each, one by one "
                f"{measured['cpu']:.2f} times that, with the disk {measured['time']:.2f} times; the bare mj_step calls "
                f"take 1/{measured['bare']:.1f} of it"
            )
            results.append({"system": name, "job": job.__name__, **measured})
            if name == "cart" and measured["cpu"] < LEAST:
                short.append(job.__name__)
    if short:
        raise SystemExit(f"one by one takes less than {LEAST} times as much CPU time: {', '.join(short)}")


if __name__ == "__main__":
    warnings.simplefilter("ignore", GoalWarning)  # of the models, which say nothing here
    main()
