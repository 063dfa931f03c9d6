"""The largest distance d* of each plant and seed, found by the deep search of ``dynamics_truths`` and kept in a file.

``python -m plants.truths`` in ``benchmarks`` computes what is missing, seed by seed.
"""

from __future__ import annotations

import argparse
from typing import Any

from ctxval import Experiment
from dynamics_truths import digest, known
from json_lines import JsonLines
from plants import PLANTS, Plant
from study_auto import RESULTS

TRUTHS = JsonLines(RESULTS / "plant_truths.jsonl", ("plant", "seed", "digest"))


def truth(plant: Plant, seed: int, found: Experiment, file: JsonLines = TRUTHS) -> dict[str, Any]:
    """Return the record of a plant and a seed, computing and storing it if it is missing; ``distance`` is d*.

    Args:
        plant: the plant.
        seed: of its experiment.
        found: the experiment of this seed, which takes a while to make.
        file: where records are kept.
    """
    return known(file, (plant.name, seed, digest(plant.make)), found, plant.samples)


def require_known(parser: argparse.ArgumentParser, names: list[str]) -> None:
    """End with a message if a plant is unknown."""
    unknown = [name for name in names if name not in PLANTS]
    if unknown:
        parser.error(f"no plant is called {', '.join(unknown)}; the plants are {', '.join(PLANTS)}.")


def main() -> None:
    """Compute what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(PLANTS), help=f"of {', '.join(PLANTS)}")
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    require_known(parser, options.names)
    for seed in range(options.seeds):
        for name in options.names:
            record = truth(PLANTS[name], seed, PLANTS[name](seed))
            repeats = ", ".join(f"{value:.4g}" for value in record["repeats"])
            print(f"{name} {seed}: d* = {record['distance']:.4g} of {repeats}, {record['seconds']} CPU s", flush=True)


if __name__ == "__main__":
    main()
