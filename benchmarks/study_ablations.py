"""What each part of the search ``auto`` buys: the same campaigns without it, case by case and seed by seed.

Distances are stored in a file, a line for a case, a seed and what is left out, so a stopped study goes on; then the
table is printed. ``python benchmarks/study_ablations.py linear-5 --seeds 5``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import dynamics_misleading
import dynamics_truths
import misleading
import study_auto
from ctxval import Experiment, searches
from ctxval.searches import BayesianOptimisation, TrustRegion
from dynamics_development_misleading import MISLEADING
from json_lines import JsonLines
from plants import PLANTS
from plants.truths import truth as plant_truth
from study_auto import Result, add_options, campaign, print_table, results_of, search_named, stored

CASES = ("pendulum-no-data", "linear-5", "dubins-basin", "arm-fnn", *misleading.CASES)
CHOSEN_BY = {entry.name: entry for entry in MISLEADING}
"""Systems that mislead, by which the parts of the search were chosen."""
OTHERS = {entry.name: entry for entry in dynamics_misleading.MISLEADING}
"""Systems that mislead, by which nothing was chosen."""
ON_PLANTS = {name: PLANTS[name] for name in ("fuel-control", "cart-pole", "f16-pull-up", "magnetic-levitation")}
"""Plants that are executed quickly: two of each kind. By the last two nothing was chosen."""
BUDGET = 15
"""Executions in a campaign on one of these systems."""


SYSTEMS = [*CASES, *ON_PLANTS, *CHOSEN_BY, *OTHERS]


def trust_region(**settings: Any) -> TrustRegion:
    """Return the search with other settings than the usual ones."""
    search = TrustRegion()
    vars(search).update(settings)
    return search


# Bayesian optimisation that starts as the trust region does, with one random point, is all of it but the residual.
ABLATIONS: dict[str, Callable[[], searches.Search]] = {
    "no residual": partial(BayesianOptimisation, initial=1),
    "no trust score": partial(trust_region, compare_with_surrogate=False),
    "no climbs": partial(trust_region, restrict=False),
    "no boldness": partial(trust_region, boldness=1.0),
}
"""What is left out -> the search without it."""


def prepared(case: str, seed: int, truths: Path) -> tuple[Experiment, int, float]:
    """Return a case, its budget and its maximum."""
    if case in misleading.CASES:
        found = misleading.CASES[case](seed)
        return found, misleading.BUDGET, misleading.truth(found, truths)
    if case in ON_PLANTS:
        plant = ON_PLANTS[case]
        on_plant = plant(seed)
        return on_plant, BUDGET, float(plant_truth(plant, seed, on_plant)["distance"])
    if case in dynamics_truths.ENTRIES:
        entry = dynamics_truths.ENTRIES[case]
        return entry(seed), BUDGET, float(dynamics_truths.truth(entry, seed)["distance"])
    found = study_auto.experiment(case, seed)
    return found, study_auto.CASES[case][3], study_auto.truth(case, found, truths)


def whole(case: str, seed: int, truths: Path) -> Result:
    """Return the campaign of ``auto`` itself, from where the other studies keep it."""
    study, name = (misleading, "misleading") if case in misleading.CASES else (study_auto, "auto")
    result: Result = study.run(case, seed, "auto", results_of(name), truths)
    return result


def run(case: str, seed: int, without: str, results: JsonLines, truths: Path) -> Result:
    """Return one campaign without a part, running what is not stored."""
    if without == "auto" and case in CASES:
        return whole(case, seed, truths)

    def compute() -> Result:
        found, budget, best_known = prepared(case, seed, truths)
        # All of them think thoroughly, so that they differ in one part alone.
        search = search_named("auto") if without == "auto" else ABLATIONS[without]()
        return campaign(found.validation, search, seed, budget, best_known)

    return stored(results, case, seed, without, compute)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=SYSTEMS, help=f"of {', '.join(SYSTEMS)}")
    parser.add_argument("--search", nargs="+", default=["auto", *ABLATIONS], help="auto, or what is left out")
    add_options(parser, "ablations")
    parser.set_defaults(seeds=5)
    print_table(parser.parse_args(), run)


if __name__ == "__main__":
    main()
