"""Verdicts on 99 % of the tasks, with a running robot in the family of M's parameters and outside, and a smooth case.

``python benchmarks/study_share.py --seeds 3`` runs what ``results/task_share.jsonl`` does not have yet, and writes
``docs/how-to/share.md``. The threshold is a share of the 0.99 quantile of the distance over 20,000 random tasks; the
robot is the HalfCheetah of ``study_parameters.py``. Needs the extra ``mujoco``.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np

from ctxval import Campaign, Validation
from ctxval.cli.config.settings import load_experiment
from json_lines import JsonLines
from study_parameters import cheetah

RESULTS = Path(__file__).parent / "results" / "task_share.jsonl"
SHARE, FACTORS, BUDGET, TASKS = 0.99, (0.95, 1.25), 30, 20_000
CASES = ("cheetah inside", "dubins", "cheetah armature", "cheetah slope")


def validation_of(case: str) -> Validation:
    """Return the validation of a case."""
    name, _, what = case.partition(" ")
    return cheetah(what) if name == "cheetah" else load_experiment(name).validation


def truth_of(results: JsonLines, case: str) -> np.ndarray:
    """Return the largest distances of random tasks, in descending order, and store them."""
    if (case, 0.0, -1) not in results:
        validation = validation_of(case)
        distances = validation.distances(validation.space.iid(TASKS, np.random.default_rng(99)))
        largest = np.sort(distances)[::-1][: TASKS // 20]
        results.append({"case": case, "factor": 0.0, "seed": -1, "largest": [float(f"{d:.7g}") for d in largest]})
    return np.array(results[case, 0.0, -1]["largest"])


def run(results: JsonLines, case: str, factor: float, seed: int) -> None:
    """Run a campaign and store how it ended."""
    largest = truth_of(results, case)
    quantile = float(largest[round((1 - SHARE) * TASKS)])
    campaign, begun = Campaign(validation_of(case), seed=seed), time.process_time()
    threshold = factor * quantile
    campaign.run(BUDGET, threshold=threshold, share=SHARE)
    verdict = campaign.verdict(threshold, share=SHARE)
    bound = None if verdict.certificate is None else verdict.certificate.upper_bound / quantile
    record = {
        "case": case, "factor": factor, "seed": seed, "answer": verdict.answer, "executions": campaign.executions,
        "bound": bound, "cpu": (time.process_time() - begun) / campaign.executions,
        "above": float((largest > threshold).sum() / TASKS), "reason": verdict.reason,
    }  # fmt: skip
    results.append(record)
    print(record, flush=True)


def main() -> None:
    """Run the missing campaigns, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    options, results = parser.parse_args(), JsonLines(RESULTS, ("case", "factor", "seed"))
    warnings.simplefilter("ignore")
    for case in options.cases:
        for seed in range(options.seeds):
            for factor in FACTORS:
                if (case, factor, seed) not in results:
                    run(results, case, factor, seed)


if __name__ == "__main__":
    main()
