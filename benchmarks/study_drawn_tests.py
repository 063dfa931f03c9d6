"""Do drawn tests keep verdicts from systems that differ in few tasks? Lifts, posts and their kin, at 0.95 d*.

Two questions are asked of the development half of the strangers whose dynamics are other in some tasks or places.
First, is any of 50 campaigns validated, which would be false? Campaigns run as a user runs them, until they decide.
Second, which tests meet what is other? Eight tasks are drawn without campaigns by each design alone: the Latin
hypercube of campaigns, one of another kind that leaves no interval wider than 12 % of a range without a test, corners
and edges, and independent draws. ``python benchmarks/study_drawn_tests.py`` runs what is not stored yet, and prints two
tables.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from calibrate_strangers import BUDGET
from ctxval import Campaign
from ctxval._util.arrays import Array, single_threaded
from ctxval._util.boxes import latin_hypercube
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.prediction_tests import TESTS
from dynamics_truths import digest
from json_lines import JsonLines
from strangers import Stranger
from strangers_development import DEVELOPMENT
from strangers_diagnostics import JudgedRun
from strangers_truths import TOUCHED, TRUTHS

LIFTS = ("heavy-bin", "wet-surface", "shelf-and-size", "reverse-gear")
"""Systems whose dynamics are other in some tasks: the lift with a heavy bin and its kin."""
POSTS = ("hidden-post", "docking-magnet", "warm-updraft")
"""Systems whose dynamics are other in a small place: the post in the plane and its kin."""

SHARE, SEEDS = 0.95, 50
DRAWS = 200
"""Sets of eight tests that are drawn by each design."""

STORED = JsonLines(RESULTS / "drawn_tests.jsonl", ("entry", "what", "seed"))


# Campaigns


def decide(run: tuple[str, int]) -> dict[str, Any]:
    """Return what is stored of one campaign; its system has the seed 0 or 1, whose d* is known."""
    name, seed = run
    started, entry = time.process_time(), DEVELOPMENT[name]
    validation, largest = entry(seed % 2).validation, truth(entry, seed % 2)
    with single_threaded():
        campaign = Campaign(validation, seed=seed)
        stopped = JudgedRun(campaign, SHARE * largest).run(BUDGET)
        verdict = campaign.verdict(SHARE * largest)
    return {
        "entry": name,
        "what": "campaign",
        "seed": seed,
        "answer": verdict.answer,
        "executions": campaign.executions,
        "origins": [trial.origin for trial in campaign.trials],
        "largest": max(trial.distance or 0.0 for trial in campaign.trials) / largest,
        "reason": verdict.reason[:300],
        "stopped": stopped,
        "seconds": round(time.process_time() - started, 1),
    }


def truth(entry: Stranger, seed: int) -> float:
    """Return d* of an entry and a seed."""
    return float(TRUTHS[entry.name, seed, digest(entry.make)]["distance"])


# Designs of tests, each a function of the number of task parameters and a generator to unit points (TESTS, d)


def corners(d: int, rng: np.random.Generator) -> Array:
    """Return tasks on corners and edges: each parameter is at one of its bounds with probability 1/2."""
    return np.where(rng.random((TESTS, d)) < 0.5, rng.integers(2, size=(TESTS, d)), rng.random((TESTS, d)))


def independent(d: int, rng: np.random.Generator) -> Array:
    """Return independent draws."""
    return rng.random((TESTS, d))


def without_gaps(d: int, rng: np.random.Generator) -> Array:
    """Return tasks that leave no interval of a parameter wider than ``WIDEST`` without one, in random pairs."""
    values = np.empty((TESTS, d))
    for k in range(TESTS):
        below = values[k - 1] if k else np.zeros(d)
        least = np.maximum(1 - (TESTS - k) * WIDEST, below)
        values[k] = rng.uniform(least, np.minimum(below + WIDEST, 1))
    return rng.permuted(values, axis=0)


WIDEST = 0.12

DESIGNS: dict[str, Callable[[int, np.random.Generator], Array]] = {
    "hypercube": partial(latin_hypercube, TESTS),  # as the tests of campaigns are
    "without gaps": without_gaps,
    "corners": corners,
    "independent draws": independent,
}


def power(run: tuple[str, int]) -> dict[str, Any]:
    """Return in which share of the sets of tests one meets what is other, and in which one would fail for it.

    A test meets it if its distance is another than without the mechanism. It would fail if the difference is larger
    than predictions may be wrong, as a share of the threshold.
    """
    name, seed = run
    entry, met, failing = DEVELOPMENT[name], {}, {}
    assert entry.without is not None
    validation, plain = entry(seed).validation, entry.without(seed).validation
    space, limit = validation.space, LIMITS.error * SHARE * truth(entry, seed)
    for design, drawn in DESIGNS.items():
        rng = np.random.default_rng([seed, 0x6472])
        points = space.from_unit(np.concatenate([drawn(space.dimension, rng) for _ in range(DRAWS)]))
        distances, without = validation.distances(points), plain.distances(points)
        touched = ~np.isclose(distances, without, rtol=TOUCHED, atol=1e-9)
        wrong = np.abs(distances - without) > limit
        met[design], failing[design] = (
            float(tests.reshape(DRAWS, TESTS).any(axis=1).mean()) for tests in (touched, wrong)
        )
    return {"entry": name, "what": "power", "seed": seed, "met": met, "failing": failing}


# Tables


def campaigns_table() -> list[list[str]]:
    """Return how the campaigns of each system ended, after how many executions."""
    rows = []
    for name in (*LIFTS, *POSTS):
        lines = STORED.select(entry=name, what="campaign")
        answers = Counter(line["answer"] for line in lines)
        executions = f"{np.median([line['executions'] for line in lines]):g}" if lines else "-"
        counts = [str(answers[answer]) for answer in ("validated", "falsified", "undecided")]
        rows.append([name, str(len(lines)), *counts, executions])
    return rows


def power_table() -> list[list[str]]:
    """Return the power of each design on each system, over the seeds of the system."""
    rows = []
    for name in (*LIFTS, *POSTS):
        lines = STORED.select(entry=name, what="power")
        shares = [
            [100 * float(np.mean([line[kind][design] for line in lines])) if lines else np.nan for design in DESIGNS]
            for kind in ("met", "failing")
        ]
        rows.append([name, *(f"{met:.0f} / {fails:.0f}" for met, fails in zip(*shares, strict=True))])
    return rows


def main() -> None:
    """Run what is missing, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = (*LIFTS, *POSTS)
    parser.add_argument("names", nargs="*", default=names, help=", ".join(names))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    for run in [(name, seed) for name in names for seed in range(2)]:
        if (run[0], "power", run[1]) not in STORED:
            STORED.append(power(run))
    print("of 200 sets of eight tests, % that meet what is other / that would fail for it:", *DESIGNS, sep=" | ")
    for row in power_table():
        print(*row, sep=" | ", flush=True)
    runs = [(name, seed) for seed in range(options.seeds) for name in options.names]
    for result in all_of(decide, [run for run in runs if (run[0], "campaign", run[1]) not in STORED], options.workers):
        STORED.append(result)
        print(*(result[key] for key in ("entry", "seed", "answer", "executions", "seconds")), flush=True)
    print("system", "campaigns", "validated", "falsified", "undecided", "median executions", sep=" | ")
    for row in campaigns_table():
        print(*row, sep=" | ")


if __name__ == "__main__":
    main()
