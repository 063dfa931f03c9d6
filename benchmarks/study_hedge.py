"""Whether ``auto`` ever needs much longer than its fallback: executions to 1 % of d*, beside the surrogate alone.

``scalar`` sees distances alone; ``auto`` sees trajectories too, and may be misled by what it learns from them.
``python benchmarks/study_hedge.py`` runs what is not stored yet. The hedge was tuned on the systems of
``hedge_systems.py`` and on the development systems; the reporting systems were run with the result. ``--search`` names
what is stored, such as ``auto-before``.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from ctxval import Campaign
from ctxval._util.arrays import single_threaded
from dynamics_development import DEVELOPMENT
from dynamics_reporting import REPORTING
from dynamics_truths import truth
from hedge_systems import HEDGE
from json_lines import JsonLines
from named_searches import search_named

BUDGET, SEEDS, WITHIN = 30, 3, 0.99
STORED = JsonLines(RESULTS / "hedge.jsonl", ("entry", "seed", "search"))
SYSTEMS = {"hedge": HEDGE, "development": DEVELOPMENT, "reporting": REPORTING}
ENTRIES = {name: entry for entries in SYSTEMS.values() for name, entry in entries.items() if entry.family != "noise"}


def study(run: tuple[int, str, str]) -> dict[str, Any]:
    """Return the distances of one campaign, as shares of d*, until one is within 1 % of it."""
    seed, entry, search = run
    largest = float(truth(ENTRIES[entry], seed)["distance"])
    started = time.process_time()
    with single_threaded():
        chosen = search_named(search.partition("-")[0])
        campaign = Campaign(ENTRIES[entry](seed).validation, search=chosen, seed=seed)
        campaign.run(BUDGET, explore=True, until=lambda running: (running.estimate or 0) >= WITHIN * largest)
    return {
        "entry": entry,
        "seed": seed,
        "search": search,
        "distances": [None if trial.distance is None else trial.distance / largest for trial in campaign.trials],
        "notes": [trial.note.to_json() or None for trial in campaign.trials],
        "seconds": round(time.process_time() - started, 1),
    }


def executions(line: dict[str, Any]) -> float:
    """Return the number of executions until one is within 1 % of d*; infinity if none was."""
    found = np.array([np.nan if distance is None else distance for distance in line["distances"]])
    return float(found.size) if (found >= WITHIN).any() else np.inf


def main() -> None:
    """Run all campaigns that are not stored; print executions to 1 % of d*, seed by seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", choices=SYSTEMS, default="hedge")
    parser.add_argument("--search", nargs="+", default=["scalar", "auto"])
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    names = [name for name in SYSTEMS[options.systems] if name in ENTRIES]
    runs = [(seed, entry, search) for search in options.search for entry in names for seed in range(SEEDS)]
    for line in all_of(study, [run for run in runs if run[1:2] + run[:1] + run[2:] not in STORED], options.workers):
        STORED.append(line)
    print(f"| system | {' | '.join(options.search)} | largest ratio |")
    print("|---" * (2 + len(options.search)) + "|")
    for entry in names:
        counts = [[executions(STORED[entry, seed, search]) for seed in range(SEEDS)] for search in options.search]
        with np.errstate(invalid="ignore"):
            ratio = np.nanmax(np.array(counts[-1]) / np.minimum(counts[0], BUDGET))
        print(f"| {entry} | {' | '.join(', '.join(f'{one:g}' for one in row) for row in counts)} | {ratio:.2g} |")


if __name__ == "__main__":
    main()
