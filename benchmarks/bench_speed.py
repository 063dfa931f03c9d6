"""Speed of the main job: a dense truth in batches against one task at a time, and the cost of a suggestion.

Prints ratios measured in one run; run it with OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import statistics
import time

import numpy as np

from ctxval import Validation, cases, searches

TASKS = 1000
REPEATS = 3


def looped_and_batched_seconds(validation: Validation) -> tuple[float, float, float]:
    points = validation.space.grid(TASKS)
    started = time.perf_counter()
    batched = validation.distances(points)
    middle = time.perf_counter()
    looped = np.array([validation.outcome(point).distance for point in points])
    ended = time.perf_counter()
    return ended - middle, middle - started, float(np.abs(looped - batched).max())


def suggestion_seconds(count: int, dimension: int, repeats: int = 20) -> float:
    rng = np.random.default_rng(0)
    points = rng.random((count, dimension))
    search = searches.GPUCB()
    costs = []
    for _ in range(repeats):
        search.reset(dimension, seed=1)
        search.tell(points, np.sin(6 * points).sum(axis=1))
        started = time.process_time()
        search.ask(1)
        costs.append(time.process_time() - started)
    return statistics.median(costs)


def main() -> None:
    validation = cases.by_name("pendulum").validation
    ratios = []
    for _ in range(REPEATS):
        looped, batched, gap = looped_and_batched_seconds(validation)
        ratios.append(looped / batched)
        print(
            f"{TASKS} tasks: one by one {looped:.2f} s, batched {batched:.3f} s, ratio {ratios[-1]:.0f}, gap {gap:.1e}"
        )
    print(f"median ratio {statistics.median(ratios):.0f} (asked: at least 50)")
    for count, dimension in ((100, 1), (100, 11), (100, 20)):
        cost = 1000 * suggestion_seconds(count, dimension)
        asked = " (asked: at most 20)" if dimension == 1 else ""
        print(f"GP-UCB suggestion at n = {count} in {dimension}-D: {cost:.1f} ms of CPU{asked}")


if __name__ == "__main__":
    main()
