"""Do verdicts hold if only positions and angles are recorded, and the states of M are estimated from them?

The plants are those of the calibration under noise. Rates are not recorded, and the controllers are the same state
feedbacks behind a Kalman filter. ``python benchmarks/calibrate_outputs.py`` runs what is not stored yet, and prints a
table. The states were estimated in this way before any of these plants was run.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from ctxval import Campaign, Parameters, Task, Validation, controllers, systems
from ctxval._util.arrays import Array, single_threaded
from json_lines import JsonLines
from noise_development import PLANTS as DEVELOPMENT
from noise_reporting import PLANTS as REPORTING
from noise_systems import Plant, near_best, outcome, random_and_corners

RULE = 1
"""Version of the rule by which campaigns are run."""

BUDGET, SHARES = 25, (0.95, 1.25)
IMPERFECTIONS_TRIED = ("none", "encoder 0.1 %", "lag 2")
"""Noise-free ones, so that d* is the largest distance."""

PLANTS = {**DEVELOPMENT, **REPORTING}
STORED = JsonLines(RESULTS / "outputs.jsonl", ("rule", "plant", "imperfection", "seed", "share"))
TRUTHS = JsonLines(RESULTS / "outputs_truths.jsonl", ("plant", "imperfection"))


def recorded(plant: Plant) -> list[int]:
    """Return the states that are recorded: the first half, which are positions and angles."""
    return list(range(len(plant.ranges) // 2))


def without_rates(plant: Plant, imperfection: str, seed: int = 0) -> Validation:
    """Return the validation of a plant of which positions and angles are recorded."""
    given, outputs = plant(imperfection, seed).validation, recorded(plant)
    ranges = np.array(plant.ranges)

    def task(p: Parameters) -> Task:
        whole = given.task(p)
        return Task(whole.initial_state, goal=whole.goal[..., outputs], horizon=whole.horizon, dt=whole.dt)

    return Validation(
        space=given.space,
        task=task,
        system=systems.WithOutputs(given.system, outputs),
        model=given.model,
        synthesizer=controllers.OutputFeedback(
            given.synthesizer, outputs, process=3e-3 * ranges, measurement=1e-3 * ranges[outputs]
        ),
        distance=given.distance,
        start_tolerance=5.0,
        outputs=outputs,
    )


def truth(key: tuple[str, str]) -> dict[str, Any]:
    """Return d* of a plant with an imperfection: random tasks and corners, then tasks near the worst ones."""
    name, imperfection = key
    with single_threaded():
        validation, rng = without_rates(PLANTS[name], imperfection), np.random.default_rng(5)
        points = random_and_corners(validation.space.dimension, rng)
        values = _distances(validation, points)
        for share in (0.1, 0.03, 0.01, 0.003):
            points = near_best(points, values, share, 5, rng)
            values = _distances(validation, points)
    best = int(values.argmax())
    largest, point = float(values[best]), points[best].tolist()
    return {"plant": name, "imperfection": imperfection, "distance": largest, "point": point}


def _distances(validation: Validation, points: Array) -> Array:
    return np.nan_to_num(validation.distances(validation.space.from_unit(points)), nan=-1.0)


def decide(run: tuple[str, str, int, float]) -> dict[str, Any]:
    """Return what is stored of one campaign that was run until it was decided."""
    name, imperfection, seed, share = run
    largest, started = TRUTHS[name, imperfection]["distance"], time.process_time()
    with single_threaded():
        validation = without_rates(PLANTS[name], imperfection, seed + 1)
        campaign = Campaign(validation, seed=seed).run(BUDGET, share * largest, thinking=np.inf)
        verdict = campaign.verdict(share * largest)
    kind = None if verdict.certificate is None else verdict.certificate.kind
    key = {"rule": RULE, "plant": name, "imperfection": imperfection, "seed": seed, "share": share}
    return {**key, **outcome(campaign, verdict, largest, started), "kind": kind}


def rows() -> list[list[str]]:
    """Return how campaigns ended by imperfection."""
    found = list[list[str]]()
    for imperfection in IMPERFECTIONS_TRIED:
        of = {share: STORED.select(rule=RULE, imperfection=imperfection, share=share) for share in SHARES}
        below = [line["answer"] for line in of[0.95]]
        above = [line["executions"] for line in of[1.25] if line["answer"] == "validated"]
        counts = ", ".join(str(below.count(answer)) for answer in ("validated", "falsified", "undecided"))
        median = f"{np.median(above):.0f}" if above else "-"
        if below or of[1.25]:
            found.append([imperfection, counts, f"{len(above)} of {len(of[1.25])}", median])
    return found


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    names = [name for name, plant in PLANTS.items() if recorded(plant) and name != "tanks"]
    keys = [(name, imperfection) for imperfection in IMPERFECTIONS_TRIED for name in names]
    for known in all_of(truth, [key for key in keys if key not in TRUTHS], options.workers):
        TRUTHS.append(known)
    runs = [(*key, seed, share) for seed in range(options.seeds) for key in keys for share in SHARES]
    for result in all_of(decide, [run for run in runs if (RULE, *run) not in STORED], options.workers):
        STORED.append(result)
        shown = ("plant", "imperfection", "share", "answer", "executions", "bound", "seconds")
        print(*(result[key] for key in shown), flush=True)
    for row in rows():
        print(*row, sep=" | ")


if __name__ == "__main__":
    main()
