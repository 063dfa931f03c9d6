"""How often is a verdict false under noise, delays and lags, and how many executions does a true one take?

``python benchmarks/calibrate_noise.py reporting`` runs what is not stored yet and prints a table. A truth is d_q*, the
0.9 quantile of the distance at the worst task, by many executions of the true system. Rules may be chosen on the
development half alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from ctxval import Campaign, Validation
from ctxval._util.arrays import Array, single_threaded
from ctxval.core.quantiles import LEVELS
from json_lines import JsonLines
from noise_development import PLANTS as DEVELOPMENT
from noise_misleading import PLANTS as MISLEADING
from noise_reporting import PLANTS as REPORTING
from noise_systems import IMPERFECTIONS, Plant, near_best, outcome, random_and_corners

RULE = 6
"""Version of the rule by which campaigns are run. Since version 4, a vague prediction is no test; campaigns that were
over before any test in version 3 are the same. Since version 5, noise of measurements is kept however little it moves
distances; campaigns whose noise was kept from the second execution on, or that measure exactly, are the same. Since
version 6, noise may begin at an edge, which it does in no plant: 15 of 15 campaigns were the same in all digits.
Campaigns that are the same have the number of the newer version."""

CONFIDENCES = (0.8, 0.9, 0.95)
"""Those for which the coverage of bounds is counted."""

BUDGET, SEEDS, QUANTILE = 25, 2, 0.9
SHARES = (0.95, 1.25, 1.1)
"""Thresholds as shares of d_q*: the first one must not be validated, the others should be."""

HALVES: dict[str, dict[str, Plant]] = {"development": DEVELOPMENT, "reporting": REPORTING, "misleading": MISLEADING}
ALL = {name: plant for plants in HALVES.values() for name, plant in plants.items()}
STORED = JsonLines(RESULTS / "noise.jsonl", ("rule", "plant", "imperfection", "seed", "share"))
TRUTHS = JsonLines(RESULTS / "noise_truths.jsonl", ("plant", "imperfection"))


def imperfections(plant: Plant) -> list[str]:
    """Return the imperfections in which a plant is tried; a misleading one has its own noise."""
    return ["none"] if plant.name in MISLEADING else list(IMPERFECTIONS)


def truth(key: tuple[str, str]) -> dict[str, Any]:
    """Return d_q* of a plant with an imperfection: random tasks and corners, then tasks near the worst ones."""
    name, imperfection = key
    with single_threaded():
        validation, rng = ALL[name](imperfection).validation, np.random.default_rng(5)
        points, (least, many) = random_and_corners(validation.space.dimension, rng), _repeats(imperfection, name)
        values = _quantiles(validation, points, least)
        for share in (0.1, 0.03, 0.01):
            points = near_best(points, values, share, 3, rng)
            values = _quantiles(validation, points, 3 * least)
        top = points[np.argsort(-values)[:10]]
        values = _quantiles(validation, top, many)
    best = int(values.argmax())
    return {"plant": name, "imperfection": imperfection, "distance": float(values[best]), "point": top[best].tolist()}


def _repeats(imperfection: str, name: str) -> tuple[int, int]:
    settings = IMPERFECTIONS[imperfection]
    noisy = name in MISLEADING or bool({"process", "measurement"} & set(settings))
    return (20, 600) if noisy else (1, 1)


def _quantiles(validation: Validation, points: Array, repeats: int) -> Array:
    tasks = validation.space.from_unit(points)
    return np.asarray(np.quantile([validation.distances(tasks) for _ in range(repeats)], QUANTILE, axis=0))


def decide(run: tuple[str, str, int, float]) -> dict[str, Any]:
    """Return what is stored of one campaign that was run until it was decided."""
    name, imperfection, seed, share = run
    largest = TRUTHS[name, imperfection]["distance"]
    started = time.process_time()
    with single_threaded():
        campaign = Campaign(ALL[name](imperfection, seed + 1).validation, seed=seed).run(
            BUDGET, share * largest, thinking=np.inf
        )
        verdict = campaign.verdict(share * largest)
    details = {} if verdict.certificate is None else verdict.certificate.details
    key = {"rule": RULE, "plant": name, "imperfection": imperfection, "seed": seed, "share": share}
    return {
        **key,
        **outcome(campaign, verdict, largest, started),
        "noise": details.get("noise"),
        "quantile": details.get("quantile"),
        "lags": details.get("lags"),
        "acting": details.get("acting"),
        "bounds": _bounds(campaign, largest),
        "ranks": _ranks(campaign),
        "origins": [trial.origin for trial in campaign.trials],
        "distances": [None if trial.distance is None else trial.distance / largest for trial in campaign.trials],
    }


def _bounds(campaign: Campaign, largest: float) -> dict[str, float] | None:
    """Return the bounds at the end of a campaign for several confidences, as shares of d_q*; None if there is none."""
    evidence = campaign.recorder.dynamics.evidence(campaign.trials, 0.95)
    if evidence is None:
        return None
    best = max((trial.distance or 0.0 for trial in campaign.trials), default=0.0)
    return {str(c): replace(evidence, best=best, confidence=c).bound / largest for c in CONFIDENCES}


def _ranks(campaign: Campaign) -> list[float]:
    """Return the predicted probabilities of less than each executed distance, of the predictions that know noise."""
    ranks = []
    for trial in campaign.trials:
        prediction = campaign.recorder.dynamics.stored_prediction(trial)
        if prediction is not None and prediction.noise is not None and trial.distance is not None:
            quantiles = np.nan_to_num(np.array(prediction.noise.distances), posinf=1e300)
            ranks.append(float(np.interp(trial.distance, quantiles, LEVELS)))
    return ranks


HEADER = (
    *("imperfection", "at 0.95: validated (false), falsified, undecided"),
    *("at 1.25: validated", "median executions", "at 1.1: validated"),
)


def rows(half: str) -> list[list[str]]:
    """Return the answers by imperfection, or by plant if these are misleading, and the sum."""
    by = "plant" if half == "misleading" else "imperfection"
    results = [line for line in STORED.select(rule=RULE) if line["plant"] in HALVES[half]]
    groups = {key: [line for line in results if line[by] == key] for key in dict.fromkeys(line[by] for line in results)}
    return [row(name, of) for name, of in {**groups, "all": results}.items()]


def row(name: str, results: Iterable[dict[str, Any]]) -> list[str]:
    """Return the answers and executions of campaigns."""
    of = {share: [line for line in results if line["share"] == share] for share in SHARES}
    below = [line["answer"] for line in of[0.95]]
    counts = ", ".join(str(below.count(answer)) for answer in ("validated", "falsified", "undecided"))
    above = [line["executions"] for line in of[1.25] if line["answer"] == "validated"]
    near = sum(line["answer"] == "validated" for line in of[1.1])
    median = f"{np.median(above):.0f}" if above else "-"
    return [name, counts, f"{len(above)} of {len(of[1.25])}", median, f"{near} of {len(of[1.1])}"]


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("half", choices=HALVES)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--shares", nargs="*", type=float, default=list(SHARES))
    parser.add_argument("--imperfections", nargs="*", default=list(IMPERFECTIONS))
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    keys = [
        (name, imperfection)
        for name, plant in HALVES[options.half].items()
        for imperfection in imperfections(plant)
        if imperfection in options.imperfections
    ]
    for result in all_of(truth, [key for key in keys if key not in TRUTHS], options.workers):
        TRUTHS.append(result)
    runs = [(*key, seed, share) for seed in range(options.seeds) for share in options.shares for key in keys]
    for result in all_of(decide, [run for run in runs if (RULE, *run) not in STORED], options.workers):
        STORED.append(result)
        shown = ("plant", "imperfection", "seed", "share", "answer", "executions", "bound", "seconds")
        print(*(result[key] for key in shown), flush=True)
    for line in rows(options.half):
        print(*line, sep=" | ")


if __name__ == "__main__":
    main()
