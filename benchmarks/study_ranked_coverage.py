"""Should the tasks that fill gaps of the records be those where a push would change the distance most?

Campaigns execute the task whose closed loop leads farthest from the records while they leave gaps. Here the 16 farthest
tasks are ranked anew: each learned state of the posterior mean is pushed by the largest residual wherever no record is
near, and the task comes first whose distance changes most. Campaigns on the development half of the systems of
strangers are run with both rules until they are decided, and their executions and false validations are compared.
``python benchmarks/study_ranked_coverage.py`` runs what is not stored yet, and prints a table.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from calibrate import RESULTS, all_of
from calibrate_strangers import BUDGET
from ctxval import Campaign
from ctxval._util.arrays import Array, single_threaded
from ctxval.core.coverage import StateInputCoverage
from ctxval.learning import LearnedDynamics
from ctxval.learning.tolerance import pushed
from json_lines import JsonLines
from strangers_development import DEVELOPMENT
from study_drawn_tests import truth

NAMES = ("salt-bath", "wet-surface", "spinning-tracks", "heavy-bin", "stalling-wing", "hidden-post", "far-manipulator")
TRUE, FALSE = 1.25, 0.95
"""Thresholds as shares of d*, of regular and of misleading systems."""
SEEDS, CANDIDATES = 2, 16
STORED = JsonLines(RESULTS / "ranked_coverage.jsonl", ("entry", "seed", "share", "ranked"))


def ranked_coverage(learned: LearnedDynamics) -> StateInputCoverage:
    """Return the coverage with the task that is ranked first by pushes; it is computed once."""
    known: dict[str, Any] = learned.__dict__
    if "_ranked" not in known:
        coverage = learned._on_pool[1]
        known["_ranked"] = coverage if learned.noisy is not None else replace(coverage, task=most_changed(learned))
    ranked: StateInputCoverage = known["_ranked"]
    return ranked


def most_changed(learned: LearnedDynamics) -> Array:
    """Return the task ``(d,)`` whose distance changes most if the mean is pushed where no record is near."""
    planner, posterior, data = learned.study.planner, learned.posterior, learned.posterior.data
    with single_threaded():
        pool = learned.study.search.pool[:256]
        planned = planner.plan(pool)
        rows = np.concatenate([each.rows for each in planned])
        states = [loops.states[0] for loops in planner.run(posterior.mean, planned)]
        n = len(data.sizes)
        visited = np.concatenate([each.reshape(-1, n) for each in states])
        low, high = np.quantile(visited[np.isfinite(visited).all(axis=1)], [1e-3, 1 - 1e-3], axis=0)
        widths = np.maximum(high - low, 1e-9)
        recorded = cKDTree((data.pairs * data.scale + data.shift)[:, :n] / widths)
        away = [
            recorded.query(np.clip(np.nan_to_num(each / widths), -1e6, 1e6), p=np.inf)[0].max(axis=1) for each in states
        ]
        order = rows[np.argsort(-np.concatenate(away), kind="stable")[:CANDIDATES]]
        tasks = np.concatenate([learned._on_pool[1].task[None], pool[order]])
        learned_states = np.flatnonzero(data.learned)
        pushes = np.zeros((2, len(learned_states), n))
        pushes[0, np.arange(len(learned_states)), learned_states] = (np.abs(data.outputs).max(axis=0) * data.sizes)[
            learned_states
        ]
        pushes[1] = -pushes[0]
        disturbed = pushed(posterior.mean, pushes.reshape(-1, n), widths, recorded)
        plans = planner.plan(tasks)
        plain = planner.distances(posterior.mean, plans, len(tasks))
        change = np.abs(planner.distances(disturbed, plans, len(tasks)) - plain).max(axis=0)
    return np.asarray(tasks[int(np.nan_to_num(change, nan=-1.0, posinf=np.inf).argmax())])


@contextmanager
def rule(ranked: bool) -> Iterator[None]:
    """Choose tasks for coverage by this rule."""
    usual = LearnedDynamics.coverage
    try:
        if ranked:
            LearnedDynamics.coverage = property(ranked_coverage)  # type: ignore[method-assign]
        yield
    finally:
        LearnedDynamics.coverage = usual  # type: ignore[method-assign]


def decide(run: tuple[str, int, float, bool]) -> dict[str, Any]:
    """Return what is stored of one campaign that was run until it was decided."""
    name, seed, share, ranked = run
    started, entry = time.process_time(), DEVELOPMENT[name]
    largest = truth(entry, seed)
    with single_threaded(), rule(ranked):
        campaign = Campaign(entry(seed).validation, seed=seed).run(BUDGET, share * largest, thinking=np.inf)
        verdict = campaign.verdict(share * largest)
    return {
        "entry": name,
        "seed": seed,
        "share": share,
        "ranked": ranked,
        "answer": verdict.answer,
        "executions": campaign.executions,
        "seconds": round(time.process_time() - started, 1),
    }


def rows() -> list[list[str]]:
    """Return a table: the answers and executions of each rule, over the campaigns that both have run."""
    cells = []
    for share in (FALSE, TRUE):
        lines = {ranked: STORED.select(share=share, ranked=ranked) for ranked in (False, True)}
        both = set.intersection(*({(line["entry"], line["seed"]) for line in each} for each in lines.values()))
        for ranked, each in lines.items():
            pairs = [line for line in each if (line["entry"], line["seed"]) in both]
            answers = [line["answer"] for line in pairs]
            counts = [str(answers.count(answer)) for answer in ("validated", "falsified", "undecided")]
            total = sum(line["executions"] for line in pairs)
            cells.append([f"{share:g}", "push" if ranked else "distance", str(len(pairs)), *counts, str(total)])
    return cells


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(NAMES))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    runs = [
        (name, seed, FALSE if DEVELOPMENT[name].misleading else TRUE, ranked)
        for seed in range(options.seeds)
        for name in options.names
        for ranked in (False, True)
    ]
    for result in all_of(decide, [run for run in runs if run not in STORED], options.workers):
        STORED.append(result)
        print(*result.values(), flush=True)
    print("tau / d*", "ranked by", "campaigns", "validated", "falsified", "undecided", "executions", sep=" | ")
    for row in rows():
        print(*row, sep=" | ")


if __name__ == "__main__":
    main()
