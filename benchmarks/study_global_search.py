"""How much of the largest distance a global search of the true system finds, case by case and seed by seed.

The systems are simulated, so that the search evaluates true distances. Shares are stored in a file, a line for a case,
a seed and a number of evaluations, so a stopped study goes on; then a table is printed.
``python benchmarks/study_global_search.py dubins cliff-ridge-4 --seeds 10``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from math import gamma, pi
from pathlib import Path
from typing import Any

import numpy as np

import misleading
import study_auto
from ctxval import Validation
from ctxval._util.arrays import Array
from ctxval.gp.ascent import Values
from ctxval.gp.global_search import search_globally
from json_lines import JsonLines

KEY = ("case", "seed", "evaluations")
RESULTS = study_auto.RESULTS / "global_search.jsonl"
EVALUATIONS = (9000, 2000)
"""Those of a search before a certificate, and those of `auto` where a design is fast."""
REFERENCE = 30_000
"""Evaluations of one more search, from other random numbers, that may correct a stored truth upwards."""
CLIFF = 1.5e-4
"""The share of the cube in which a cliff function is large."""


@dataclass(frozen=True)
class Problem:
    """A function of the unit cube and the largest value that is known.

    Attributes:
        function: points ``(m, d)`` -> values ``(m,)``.
        dimension: d.
        truth: its maximum, or the largest value that a stored campaign names.
        exact: whether that is the maximum.
    """

    function: Values
    dimension: int
    truth: float
    exact: bool


@dataclass(frozen=True)
class Case:
    """A problem for each seed.

    Attributes:
        problem: of a seed.
        chosen_by: whether settings of the search were chosen by this case.
        affordable: largest number of evaluations.
    """

    problem: Callable[[int], Problem]
    chosen_by: bool
    affordable: int = REFERENCE


# Closed loops


def of_validation(validation: Validation, truth: float, exact: bool = False) -> Problem:
    """Return the distances of a validation over the unit cube."""
    space = validation.space
    return Problem(lambda points: validation.distances(space.from_unit(points)), space.dimension, truth, exact)


def loop(case: str, seed: int) -> Problem:
    """Return a case of the paper; its truth is that of the stored campaigns."""
    found = study_auto.experiment(case, seed)
    if case == "arm-fnn":
        # The training of the network differs between machines, so the truth of a stored campaign is another model's.
        truth = study_auto.truth(case, found, study_auto.ROOT / "runs" / "truth")
    else:
        truth = study_auto.results_of("auto")[case, seed, "auto"]["truth"]
    return of_validation(found.validation, truth, exact=case.startswith("linear"))


def misleading_loop(case: str, seed: int) -> Problem:
    """Return one of the misleading cases; its truth is that of the stored campaigns."""
    truth = study_auto.results_of("misleading")[case, seed, "auto"]["truth"]
    return of_validation(misleading.CASES[case](seed).validation, truth)


# Cliffs, whose maximum is 1


def cliff(lead: Callable[[Array, float], Array], dimension: int, seed: int) -> Problem:
    """Return waves up to 0.5, a lead to a ball, and values from 0.9 to 1 in the ball.

    Args:
        lead: offsets from the ball ``(m, d)`` and its radius -> values ``(m,)`` that are added to the waves.
        dimension: of the cube.
        seed: of the waves and of the centre, the whole ball being in the cube.
    """
    rng = np.random.default_rng([seed, dimension])
    radius = float((CLIFF * gamma(dimension / 2 + 1) / pi ** (dimension / 2)) ** (1 / dimension))
    centre = rng.uniform(radius, 1 - radius, dimension)
    frequencies, phases = rng.normal(0, 4 / np.sqrt(dimension), (3, dimension)), rng.uniform(0, 2 * pi, 3)

    def function(points: Array) -> Array:
        away = points - centre
        distance = np.linalg.norm(away, axis=1)
        waves = 0.25 + 0.25 * np.sin(points @ frequencies.T + phases).mean(axis=1)
        return np.where(distance < radius, 1 - 0.1 * distance / radius, np.minimum(waves + lead(away, radius), 0.6))

    return Problem(function, dimension, 1.0, exact=True)


def ridge(away: Array, radius: float) -> Array:
    """Return a ridge along the first coordinate that rises towards the ball."""
    along, across = np.abs(away[:, 0]), np.linalg.norm(away[:, 1:], axis=1)
    return np.asarray(0.3 * (1 - along) * np.exp(-((across / (2 * radius)) ** 2)))


def funnel(away: Array, radius: float) -> Array:
    """Return a rise towards the ball that is felt at some radii from it."""
    return np.asarray(0.3 * np.exp(-np.linalg.norm(away, axis=1) / (3 * radius)))


def trace(away: Array, radius: float) -> Array:
    """Return a slight rise close to the ball, nearly no lead."""
    return np.asarray(0.1 * np.exp(-np.linalg.norm(away, axis=1) / (2 * radius)))


CASES: dict[str, Case] = {
    **{
        f"cliff-{lead.__name__}-{d}": Case(partial(cliff, lead, d), chosen_by=True)
        for lead, d in product((ridge, funnel, trace), (3, 4, 6))
    },
    **{case: Case(partial(loop, case), True) for case in ("pendulum", "dubins", "linear-1", "linear-5")},
    "hidden-heat": Case(partial(misleading_loop, "hidden-heat"), True),
    **{
        case: Case(partial(loop, case), False)
        for case in ("dubins-basin", "dubins-heavy-tail", "linear-2", "linear-10")
    },
    **{f"arm-{model}": Case(partial(loop, f"arm-{model}"), False, 2000) for model in ("linear", "gp", "fnn")},
    **{case: Case(partial(misleading_loop, case), False) for case in ("hidden-load", "corner-stop")},
}


def search(problem: Problem, seed: int, evaluations: int, stream: int = 0) -> float:
    """Return the largest value that a search without starts finds."""
    rng = np.random.default_rng([seed, stream])
    starts = np.empty((0, problem.dimension))
    return float(search_globally(problem.function, problem.dimension, starts, rng, evaluations=evaluations).values[0])


def run(case: str, seed: int, evaluations: int, results: JsonLines) -> dict[str, Any]:
    """Return what one search finds, running what is not stored."""
    key = (case, seed, evaluations)
    if key not in results:
        problem = CASES[case].problem(seed)
        started = time.process_time()
        found = search(problem, seed, evaluations)
        seconds = time.process_time() - started
        record = {"dimension": problem.dimension, "found": found, "truth": problem.truth, "exact": problem.exact}
        results.append({**dict(zip(KEY, key, strict=True)), **record, "seconds": seconds})
    return results[key]


def reference(case: str, seed: int, results: JsonLines) -> None:
    """Store a much larger search where the truth is only the best known value, and the case is affordable."""
    if CASES[case].affordable >= REFERENCE and (case, seed, REFERENCE) not in results:
        problem = CASES[case].problem(seed)
        found = problem.truth if problem.exact else search(problem, seed, REFERENCE, stream=1)
        record = {"dimension": problem.dimension, "found": found, "truth": problem.truth, "exact": problem.exact}
        results.append({"case": case, "seed": seed, "evaluations": REFERENCE, **record})


def shares(case: str, evaluations: int, results: JsonLines) -> list[float]:
    """Return the shares of the largest known value that searches found, seed by seed."""
    found = []
    for record in results.select(case=case, evaluations=evaluations):
        known = results.select(case=case, seed=record["seed"])
        found.append(record["found"] / max(max(other["found"], other["truth"]) for other in known))
    return found


def surpassed(results: JsonLines) -> list[str]:
    """Return where a search has found more than 1 % above the stored truth."""
    found = []
    for case in CASES:
        for seed in sorted({record["seed"] for record in results.select(case=case)}):
            best = max(results.select(case=case, seed=seed), key=lambda record: float(record["found"]))
            if best["found"] > 1.01 * best["truth"]:
                found.append(f"`{case}`, seed {seed}: {best['found']:.3g} instead of {best['truth']:.3g}")
    return found


def budgets(case: str) -> list[int]:
    """Return the numbers of evaluations that a case affords."""
    return [count for count in EVALUATIONS if count <= CASES[case].affordable]


def rows(results: JsonLines, chosen_by: bool) -> list[list[str]]:
    """Return a row for each number of evaluations and each case that settings were, or were not, chosen by."""
    found = []
    for evaluations, case in product(EVALUATIONS, CASES):
        if CASES[case].chosen_by != chosen_by:
            continue
        records = results.select(case=case, evaluations=evaluations)
        if records:
            reached = shares(case, evaluations, results)
            found.append(
                [
                    f"`{case}`",
                    f"{records[0]['dimension']}",
                    f"{evaluations:,}",
                    f"{statistics.median(reached):.4f}",
                    f"{min(reached):.4f}",
                    f"{sum(share >= 0.99 for share in reached)} of {len(reached)}",
                    f"{statistics.median(record['seconds'] for record in records):.2g}",
                ]
            )
    return found


HEADER = ["case", "dimensions", "evaluations", "median share", "least share", ">= 0.99", "CPU s"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES), help=f"of {', '.join(CASES)}")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--results", type=lambda path: JsonLines(Path(path), KEY), default=JsonLines(RESULTS, KEY))
    options = parser.parse_args()
    for case, seed in product(options.cases, range(options.seeds)):
        reference(case, seed, options.results)
        for evaluations in budgets(case):
            run(case, seed, evaluations, options.results)
    for row in (HEADER, *rows(options.results, True), *rows(options.results, False)):
        print("| " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
