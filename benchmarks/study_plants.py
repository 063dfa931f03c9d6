"""How many executions the searches need on the plants of the falsification literature and of robotics.

Distances are stored in a file, a line for a plant, a seed, a search and a version of the code, so a stopped study goes
on; then the table is printed. ``python benchmarks/study_plants.py fuel-control --seeds 5 --search auto``.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from json_lines import JsonLines
from named_searches import search_named
from plants import PLANTS
from plants.truths import TRUTHS, require_known, truth
from reproduce.jobs import AUTO, provenance
from study_auto import RESULTS, Result, campaign, print_table

VERSIONS = ("before", "after")
"""Of ``auto``: that of commit 85e23b1, and that of today. Other searches have one version, ``UNCHANGED``."""
UNCHANGED = "unchanged"
SEARCHES = ("auto", "scalar", "gp-ucb", "random")
SEEDS = 5
STORED = JsonLines(RESULTS / "plants.jsonl", ("case", "seed", "search", "version"))


def version_of(search: str, version: str) -> str:
    """Return the label under which the campaigns of a search are stored."""
    return version if search == "auto" else UNCHANGED


def run(version: str, case: str, seed: int, search: str, results: JsonLines, truths: JsonLines) -> Result:
    """Return one campaign on a plant, running what is not stored."""
    key = (case, seed, search, version_of(search, version))
    if key not in results:
        plant = PLANTS[case]
        found = plant(seed)
        best_known = truth(plant, seed, found, truths)["distance"]
        result = campaign(found.validation, search_named(search), seed, plant.budget, best_known)
        results.append({**dict(zip(results.key, key, strict=True)), **result, **provenance(AUTO)})
    return results[key]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(PLANTS), help=f"of {', '.join(PLANTS)}")
    parser.add_argument("--search", nargs="+", default=list(SEARCHES))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--version", choices=VERSIONS, default=VERSIONS[-1], help="label of the code of auto")
    parser.add_argument("--results", type=lambda path: JsonLines(Path(path), STORED.key), default=STORED)
    parser.set_defaults(truths=TRUTHS)
    options = parser.parse_args()
    require_known(parser, options.cases)
    print_table(options, partial(run, options.version))


if __name__ == "__main__":
    main()
