"""How many executions the searches need until they are close to the true maximum, case by case and seed by seed.

Distances are stored in a folder, one file for a case, a seed and a search, so a stopped study goes on; then the table
of medians is printed. ``python benchmarks/study_auto.py pendulum dubins-basin --seeds 10 --search auto``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Campaign, Experiment, Truth, Validation, cached_truth, cases, grid_truth, search_truth, searches

ROOT = Path(__file__).parents[1]
WITHIN = (5.0, 2.0, 1.0)

Result = dict[str, Any]

# Options of the case, whether M brings the data that it was learned from, and the budget.
CASES: dict[str, tuple[str, dict[str, Any], bool, int]] = {
    "pendulum": ("pendulum", {}, True, 6),
    "pendulum-no-data": ("pendulum", {}, False, 8),
    "dubins": ("dubins", {}, True, 20),
    "dubins-no-data": ("dubins", {}, False, 20),
    "dubins-basin": ("dubins", {"variant": "basin"}, True, 30),
    "dubins-basin-no-data": ("dubins", {"variant": "basin"}, False, 30),
    "dubins-heavy-tail": ("dubins", {"variant": "heavy-tail"}, True, 30),
    **{f"arm-{model}": ("arm", {"model": model}, True, 12) for model in ("fnn", "gp", "linear")},
    **{f"arm-{model}-no-data": ("arm", {"model": model}, False, 12) for model in ("fnn", "gp", "linear")},
    **{f"linear-{n}": ("linear", {"dim": n}, True, n + 4) for n in range(1, 11)},
}


def experiment(case: str, seed: int) -> Experiment:
    name, options, with_data, _ = CASES[case]
    found = cases.by_name(name, seed, **options)
    if not with_data:
        found.validation.model.data = None  # type: ignore[attr-defined]
    return found


def truth(case: str, found: Experiment, folder: Path) -> float:
    if case.startswith("dubins-heavy-tail"):
        # Rounding decides the distance in its corners: no search agrees with itself there, so one is stopped early.
        compute: Callable[[Validation], Truth] = partial(search_truth, repeats=2, generations=40, climbs=8)
    elif case.startswith("dubins"):
        compute = search_truth
    elif case.startswith("arm"):
        compute = partial(grid_truth, per_axis=81, refinements=3)
    else:
        assert found.truth is not None
        return found.truth().distance
    return cached_truth(found.validation, compute, folder).distance


def best_of_random(validation: Validation, seed: int, count: int = 2000) -> float:
    points = validation.space.iid(count, np.random.default_rng([seed, count]))
    return float(np.nanmax(validation.distances(points)))


def run(case: str, seed: int, search: str, folder: Path, truths: Path) -> dict[str, Any]:
    """Return the distances of one campaign, one after the other, running what is not stored."""
    path = folder / f"{case}-{seed}-{search}.json"
    if path.exists():
        stored: dict[str, Any] = json.loads(path.read_text())
        return stored
    found = experiment(case, seed)
    best_known = truth(case, found, truths)
    campaign = Campaign(found.validation, search=searches.by_name(search), seed=seed)
    started = time.process_time()
    campaign.run(CASES[case][3])
    result = {
        "truth": best_known,
        "random": best_of_random(found.validation, seed) if case.startswith("dubins") else None,
        "distances": [trial.distance for trial in campaign.trials],
        "notes": [trial.note for trial in campaign.trials],
        "seconds": (time.process_time() - started) / len(campaign.trials),
    }
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result))
    return result


def first_within(result: dict[str, Any], percent: float) -> float:
    """Return how many executions it took; infinity where the budget did not suffice."""
    enough = (1 - percent / 100) * result["truth"]
    return next((k + 1 for k, d in enumerate(result["distances"]) if d is not None and d >= enough), float("inf"))


def row(case: str, search: str, results: list[dict[str, Any]]) -> str:
    cells = []
    for percent in WITHIN:
        counts = [first_within(result, percent) for result in results]
        cells.append(f"{statistics.median(counts):g} ({', '.join(f'{count:g}' for count in counts)})")
    shares = [max(d or 0 for d in result["distances"]) / result["random"] for result in results if result.get("random")]
    cells.append(f"{min(shares):.2f}" if shares else "-")
    seconds = statistics.mean(result["seconds"] for result in results)
    return f"| {case} | {search} | " + " | ".join(cells) + f" | {seconds:.2f} |"


def add_options(parser: argparse.ArgumentParser, name: str) -> None:
    """Add the options that the studies have in common; results go to a folder of the study's name."""
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--folder", type=Path, default=ROOT / "benchmarks" / "results" / name)
    parser.add_argument("--truths", type=Path, default=ROOT / "runs" / "truth")


def print_rows(options: argparse.Namespace, run: Callable[..., Result], row: Callable[..., str]) -> None:
    """Run what is missing, and print a row for each case and search as soon as it is there."""
    for case in options.cases:
        for search in options.search:
            results = [run(case, seed, search, options.folder, options.truths) for seed in range(options.seeds)]
            print(row(case, search, results), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES), help=f"of {', '.join(CASES)}")
    parser.add_argument("--search", nargs="+", default=["auto"])
    add_options(parser, "auto")
    options = parser.parse_args()
    print(
        "| case | search | "
        + " | ".join(f"{percent:g} %" for percent in WITHIN)
        + " | least share of 2,000 random | CPU s a suggestion |"
    )
    print("|---" * (4 + len(WITHIN)) + "|")
    print_rows(options, run, row)


if __name__ == "__main__":
    main()
