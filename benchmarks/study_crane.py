"""Whether verdicts on the crane are true, and whether its worst task can be typed again.

The truth d* is the largest distance that a search with many executions finds among rounded tasks. Campaigns are judged
at 0.9 d*, which must be falsified, and at 1.1 d*, which must not; those that run until they are decided too.

    python benchmarks/study_crane.py --seeds 3 --out benchmarks/results/crane.jsonl
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from crane import experiment
from ctxval import Campaign, Validation, searches
from ctxval._util.arrays import Array
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.core.controller import converged_of
from ctxval.gp.global_search import search_globally

BUDGET, TASKS, EVALUATIONS = 15, 250, 6000
DIGITS = 9


def truth(validation: Validation, evaluations: int = EVALUATIONS) -> float:
    """Return the largest distance of rounded tasks."""
    space = validation.space

    def distance(unit: Array) -> Array:
        return validation.distances(space.from_unit(space.rounded(unit)))

    rng = np.random.default_rng(0)
    return float(
        search_globally(distance, space.dimension, rng.random((64, 2)), rng, evaluations=evaluations).values[0]
    )


def typed(validation: Validation, task: dict[str, Any], moved: float = 0.0) -> float:
    """Return the distance of a task that is typed again with nine digits, and moved."""
    again = {name: float(f"{value:.{DIGITS}g}") + moved for name, value in task.items()}
    point = np.array([again[name] for name in validation.space.names])
    return float(validation.outcome(np.clip(point, validation.space.low, validation.space.high)).distance)


def decided(validation: Validation, threshold: float, seed: int) -> tuple[str, int]:
    """Return the verdict of a campaign that runs until it is decided, and its number of executions."""
    campaign = Campaign(validation, seed=seed)
    campaign.run(BUDGET, threshold, thinking=np.inf)
    return campaign.verdict(threshold).answer, campaign.executions


def study(seed: int) -> dict[str, Any]:
    """Return what is found on the crane of a seed."""
    validation = experiment(seed).validation
    points = validation.space.iid(TASKS, np.random.default_rng(1))
    drawn = validation.distances(points)
    told = [converged_of(plan.controller) for plan in validation.plans(points)]
    largest = truth(validation)
    begun = time.process_time()
    campaign = Campaign(validation, search=searches.Auto("thorough"), seed=seed).run(BUDGET, explore=True)
    seconds = time.process_time() - begun
    worst = campaign.worst
    assert worst is not None
    options = CertificateOptions(DistanceBound())
    return {
        "seed": seed,
        "d_star": largest,
        "median": float(np.median(drawn)),
        "largest_of_random": float(drawn.max()),
        "not_converged_of_random": sum(not one for one in told),
        "worst": worst.distance,
        "typed_again": typed(validation, worst.parameters),
        "beside": max(typed(validation, worst.parameters, moved) for moved in (1e-10, -1e-10)),
        "rejected": sum(trial.note.unsteady or 0 for trial in campaign.trials),
        "executions": campaign.executions,
        "verdicts": {str(share): campaign.verdict(share * largest, certificate=options).answer for share in (0.9, 1.1)},
        "until_decided": {str(share): decided(validation, share * largest, seed) for share in (0.9, 1.1)},
        "cpu_seconds": round(seconds, 1),
    }


def main() -> None:
    """Study some seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows = []
    for seed in range(given.seeds):
        rows.append(json.dumps(study(seed)))
        print(rows[-1], flush=True)
    if given.out is not None:
        given.out.write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
