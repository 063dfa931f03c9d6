"""What each entry is: its dimensions, the time of closed loops, and how far its mechanism changes distances.

``python benchmarks/dynamics_check.py --lists development reporting`` prints a table. No certificate is computed.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import dynamics_development
import dynamics_reporting
from ctxval._util.arrays import Array
from dynamics_systems import Entry

LISTS = {"development": dynamics_development.DEVELOPMENT, "reporting": dynamics_reporting.REPORTING}
COUNT = 20000


def sample(entry: Entry, seed: int, count: int = COUNT) -> tuple[Array, Array]:
    """Return distances ``(N,)`` at random tasks, with and without the mechanism; NaN if there is none."""
    validation = entry(seed).validation
    points = validation.space.iid(count, np.random.default_rng(0))
    values = validation.distances(points)
    if entry.without is None:
        return values, np.full(count, np.nan)
    return values, entry.without(seed).validation.distances(points)


def met(values: Array, plain: Array) -> float:
    """Return the share of tasks whose distance the mechanism changes by more than a quarter of the median without."""
    return float((np.abs(values - plain) > 0.25 * np.nanmedian(plain)).mean())


def tracking(entry: Entry, seed: int) -> float:
    """Return the median over tasks of how much of the initial deviation from the goal M's closed loop removes."""
    validation = entry(seed).validation
    parameters = validation.space.parameters(validation.space.iid(500, np.random.default_rng(1)))
    plan = validation.plan_of(parameters, validation.task_at(parameters))
    ends = np.linalg.norm(plan.model_trajectory.final_state - plan.task.goal, axis=-1)
    begins = np.linalg.norm(plan.task.initial_state - plan.task.goal, axis=-1)
    return float(np.median(ends / np.maximum(begins, 1e-9)))


def row(entry: Entry, seed: int) -> str:
    """Return the row of the table."""
    dimension, pairs, horizon = entry.dimensions()
    started = time.process_time()
    values, plain = sample(entry, seed)
    milliseconds = (time.process_time() - started) / len(values) * 1e6 / (1 if entry.without is None else 2)
    middle, top = np.nanmedian(values), np.nanmax(values)
    cells = [
        entry.name, entry.family, "yes" if entry.misleading else "no", dimension, pairs, horizon, f"{milliseconds:.0f}",
        f"{middle:.3g}", f"{top:.3g}", f"{top / middle:.1f}", f"{np.mean(values > 0.8 * top):.1e}",
        f"{np.isnan(values).mean():.1e}", f"{tracking(entry, seed):.2f}",
        "-" if np.isnan(plain).all() else f"{met(values, plain):.2g}",
        "-" if np.isnan(plain).all() else f"{top / np.nanmax(plain):.2f}",
    ]  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


HEADS = (
    "entry", "family", "misleading", "tasks", "n + m", "H", "ms / 1000", "median", "top", "top / median",
    "above 0.8 top", "failed", "M's rest", "met", "top / top without",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--lists", nargs="+", choices=LISTS, default=list(LISTS))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| " + " | ".join(HEADS) + " |")
    print("|---" * len(HEADS) + "|")
    for name in options.lists:
        for entry in LISTS[name].values():
            if not options.names or entry.name in options.names:
                print(row(entry, options.seed), flush=True)


if __name__ == "__main__":
    main()
