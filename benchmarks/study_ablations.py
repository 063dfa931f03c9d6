"""What each part of the search ``auto`` buys: the same campaigns without it, case by case and seed by seed.

Distances are stored in a file, a line for a case, a seed and what is left out, so a stopped study goes on; then the
table is printed. ``python benchmarks/study_ablations.py linear-5 --seeds 5``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import misleading
import study_auto
from ctxval import Experiment, searches
from ctxval._util.arrays import Array
from ctxval._util.json_lines import JsonLines
from ctxval.gp import regression as gp
from ctxval.searches import Climbs, Prediction, Scalar
from ctxval.searches import trust_region as climbs
from study_auto import Result, add_options, campaign, print_table, results_of, stored

CASES = ("pendulum-no-data", "linear-5", "dubins-basin", "arm-fnn", *misleading.CASES)


class NoDiscrepancy(Climbs):
    """Climbs that take the predicted distance as it is, however wrong it was at known points."""

    def _discrepancy(self, prediction: Prediction) -> gp.GaussianProcess | None:
        return None


class NoTrustScore(Climbs):
    """Climbs that use the prediction however bad leaving executions out shows it to be."""

    def _why_not(self, prediction: Prediction) -> str | None:
        return None


class NoClimbs(Climbs):
    """The most promising point of the whole cube each time: no trust region, and no restarts elsewhere."""

    def _climb(self, prediction: Prediction, rng: np.random.Generator) -> Array | None:
        promise = climbs._Promise(prediction, self._discrepancy(prediction), self._calibrated())
        point = self._best(promise, climbs._Climb(), prediction.budget, rng)
        return None if point is None else self._noted(prediction, point, climbs._Climb())


# A scalar search that starts as the climbs do, with one random point, is all of it but the residual.
ABLATIONS: dict[str, Callable[[], searches.Search]] = {
    "no residual": partial(Scalar, initial=1),
    "no discrepancy": NoDiscrepancy,
    "no trust score": NoTrustScore,
    "no climbs": NoClimbs,
}
"""What is left out -> the search without it."""


def prepared(case: str, seed: int, truths: Path) -> tuple[Experiment, int, float]:
    """Return a case, its budget and its maximum."""
    if case in misleading.CASES:
        found = misleading.CASES[case](seed)
        return found, misleading.BUDGET, misleading.truth(found, truths)
    found = study_auto.experiment(case, seed)
    return found, study_auto.CASES[case][3], study_auto.truth(case, found, truths)


def whole(case: str, seed: int, truths: Path) -> Result:
    """Return the campaign of ``auto`` itself, from where the other studies keep it."""
    study, name = (misleading, "misleading") if case in misleading.CASES else (study_auto, "auto")
    result: Result = study.run(case, seed, "auto", results_of(name), truths)
    return result


def run(case: str, seed: int, without: str, results: JsonLines, truths: Path) -> Result:
    """Return one campaign without a part, running what is not stored."""
    if without == "auto":
        return whole(case, seed, truths)

    def compute() -> Result:
        found, budget, best_known = prepared(case, seed, truths)
        return campaign(found.validation, ABLATIONS[without](), seed, budget, best_known)

    return stored(results, case, seed, without, compute)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES), help=f"of {', '.join(CASES)}")
    parser.add_argument("--search", nargs="+", default=["auto", *ABLATIONS], help="auto, or what is left out")
    add_options(parser, "ablations")
    parser.set_defaults(seeds=5)
    print_table(parser.parse_args(), run)


if __name__ == "__main__":
    main()
