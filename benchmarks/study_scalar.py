"""How many executions the searches that never see a trajectory need, case by case and seed by seed.

``scalar``, ``gp-ucb`` and ``random`` see distances alone; ``vector`` sees the vectors that distances are composed of,
where they are. Distances are stored in a file, a line for a case, a seed and a search, so a stopped study goes on; then
the table is printed. ``python benchmarks/study_scalar.py linear-10 dubins-basin --seeds 10``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from ctxval import Validation, searches
from ctxval._util.arrays import Array
from ctxval.distances import ComposedDistance
from ctxval.learning.prediction import predict_composed
from json_lines import JsonLines
from named_searches import search_named
from study_auto import Result, add_options, experiment, first_within, print_rows, stored, truth

BUDGETS = {"pendulum": 25, "dubins-basin": 100, "dubins-heavy-tail": 100}
BUDGETS |= {f"arm-{model}": 40 for model in ("fnn", "gp", "linear")} | {f"linear-{n}": 50 for n in range(1, 11)}
WITHIN = (5.0, 1.0)
SEARCHES = ("scalar", "gp-ucb", "random", "vector")


def suggest_by_value(name: str, validation: Validation, seed: int) -> Callable[[list[Array], list[float]], Array]:
    search = search_named(name)
    search.reset(validation.space.dimension, seed)

    def suggest(points: list[Array], values: list[float]) -> Array:
        if points:
            search.tell(points[-1:], values[-1:])
        return np.asarray(search.ask(1)[0])

    return suggest


def suggest_by_vector(validation: Validation, seed: int) -> Callable[[list[Array], list[float]], Array]:
    distance, search = validation.distance, searches.TrustRegion()
    assert isinstance(distance, ComposedDistance), "this case's distance is not composed of a vector"
    search.reset(validation.space.dimension, seed)
    vectors: list[Array] = []

    def suggest(points: list[Array], values: list[float]) -> Array:
        if points:
            search.tell(points[-1:], values[-1:])
            plan = validation.plan(validation.space.from_unit(points[-1]))
            vectors.append(distance.error(plan.model_trajectory, validation.execute(plan), plan.task))
        if len(vectors) > 1:
            search.use_prediction(predict_composed(np.array(points), np.array(vectors), distance.compose))
        return np.asarray(search.ask(1)[0])

    return suggest


def run(case: str, seed: int, search: str, results: JsonLines, truths: Path) -> Result:
    """Return the distances of one search of a case, running what is not stored."""
    return stored(results, case, seed, search, partial(searched, case, seed, search, truths))


def searched(case: str, seed: int, search: str, truths: Path) -> Result:
    """Return the distances of one search, one after the other, up to 1 % of the maximum."""
    found = experiment(case, seed)
    best_known = truth(case, found, truths)
    validation = found.validation
    suggest = suggest_by_vector(validation, seed) if search == "vector" else suggest_by_value(search, validation, seed)
    points: list[Array] = []
    values: list[float] = []
    seconds = 0.0
    while len(values) < BUDGETS[case] and max(values, default=0.0) < 0.99 * best_known:
        started = time.process_time()
        points.append(suggest(points, values))
        seconds += time.process_time() - started
        values.append(float(validation.distances(validation.space.from_unit(points[-1])[None])[0]))
    return {"truth": best_known, "budget": BUDGETS[case], "distances": values, "seconds": seconds / len(values)}


def row(case: str, search: str, results: list[Result]) -> str:
    cells = []
    for percent in WITHIN:
        counts = [first_within(result, percent) for result in results]
        reached = sum(np.isfinite(counts))
        each = ", ".join(f"{count:g}" for count in counts)
        cells.append(f"{statistics.median(counts):g}; {reached}/{len(counts)} ({each})")
    shares = [max(result["distances"]) / result["truth"] for result in results]
    cells.append(f"{min(shares):.3f}")
    seconds = statistics.mean(result["seconds"] for result in results)
    return f"| {case} | {search} | {BUDGETS[case]} | " + " | ".join(cells) + f" | {seconds:.3f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="+", help=f"of {', '.join(BUDGETS)}")
    parser.add_argument("--search", nargs="+", default=["scalar", "gp-ucb", "random"], choices=SEARCHES)
    add_options(parser, "scalar")
    options = parser.parse_args()
    within = " | ".join(f"{percent:g} %: median; seeds that got there" for percent in WITHIN)
    print(f"| case | search | budget | {within} | least share of d* | CPU s a suggestion |")
    print("|---" * (5 + len(WITHIN)) + "|")
    print_rows(options, run, row)


if __name__ == "__main__":
    main()
