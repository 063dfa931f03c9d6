"""How often is `validated` false, and what does a verdict cost? Campaigns that run until they are decided.

``python benchmarks/calibrate_verdicts.py`` runs what is not stored yet. Each campaign is given a threshold of a known
share of d*: 0.95, which must not be validated, or 1.1, which should be, and runs as ``--until-decided`` does.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibrate import FAMILIES, RESULTS, STORED, SYSTEMS, all_of, append, lines, maximum
from ctxval import Campaign, Trial, cases, searches
from ctxval.arrays import Array, single_threaded
from ctxval.reproduce.jobs import Job, Results
from ctxval.verdict import counterexample, standing

BUDGETS = {1: 30, 2: 60}
"""Executions at most; in four dimensions no such budget comes near to every task."""

SHARES = (0.95, 1.1)
"""Thresholds, as shares of d*."""

SEARCHES = ("gp-ucb", "scalar")
"""For functions; ``auto`` is ``scalar`` where there are no trajectories."""

DRIVEN = ("pendulum", "arm, linear", "linear, 1 state")
"""Systems of few dimensions, searched by ``auto``, which learns from their trajectories."""


@dataclass(frozen=True)
class Decision:
    """One campaign, fully said by its fields."""

    family: str
    dimension: int
    search: str
    share: float
    seed: int


def wanted(campaigns: int) -> Iterator[Decision]:
    """Yield all campaigns: functions that must not be validated, systems, and a few functions that should be."""
    yield from _functions(SHARES[0], campaigns)
    for seed in range(10):
        for share in SHARES:
            yield from (Decision(name, SYSTEMS[name].dimension, "auto", share, seed) for name in DRIVEN)
    yield from _functions(SHARES[1], campaigns // 4)


def _functions(share: float, campaigns: int) -> Iterator[Decision]:
    for seed in range(campaigns):
        for family, (_, dimensions) in FAMILIES.items():
            for d in sorted(set(dimensions) & set(BUDGETS)):
                if seed < campaigns * (1.0 if d == 1 else 0.6):
                    yield from (Decision(family, d, search, share, seed) for search in SEARCHES)


def decide(one: Decision) -> dict[str, Any]:
    """Run one campaign until it is decided."""
    with single_threaded():
        result = _of_system(one) if one.family in SYSTEMS else _of_function(one)
    return {"seed": one.seed, "search": one.search, "share": one.share, **result}


def _of_function(one: Decision) -> dict[str, Any]:
    make, _ = FAMILIES[one.family]
    values = make(one.dimension, np.random.default_rng([one.seed, one.dimension, sorted(FAMILIES).index(one.family)]))
    # A distance is not negative.
    lowest = float(values(np.random.default_rng(0).random((2000, one.dimension))).min())
    threshold, budget = one.share * (maximum(values, one.dimension) - lowest), BUDGETS[one.dimension]
    search = searches.by_name(one.search)
    search.reset(one.dimension, one.seed)
    trials: list[Trial] = []
    while len(trials) < budget:
        now = standing(trials, threshold, budget - len(trials))
        if now.decided:
            return _summary(trials, threshold, decided=True)
        point = search.ask()[0] if now.uncovered is None else now.uncovered
        distance = max(0.0, float(values(point[None])[0]) - lowest)
        search.tell(point[None], [distance])
        trials.append(_trial(len(trials), "acquisition" if now.uncovered is None else "covering", point, distance))
    return _summary(trials, threshold, decided=standing(trials, threshold, 0).decided)


def _trial(number: int, origin: Any, point: Array, distance: float) -> Trial:
    return Trial(number, origin, "completed", point, {}, 1, True, distance)


def _of_system(one: Decision) -> dict[str, Any]:
    system = SYSTEMS[one.family]
    best_known = Results(STORED)[Job("truth", system.case, one.seed, system.options)]["distance"]
    experiment = cases.by_name(system.case, one.seed, **dict(system.options))
    threshold, budget = one.share * best_known, BUDGETS[one.dimension]
    campaign = Campaign(experiment.validation, search=searches.by_name(one.search), seed=one.seed)
    campaign.run_until_decided(threshold, budget)
    return _summary(list(campaign.trials), threshold, decided=standing(campaign.trials, threshold, 0).decided)


def _summary(trials: list[Trial], threshold: float, *, decided: bool) -> dict[str, Any]:
    falsified = counterexample(trials, threshold) is not None
    return {
        "answer": "falsified" if falsified else "validated" if decided else "undecided",
        "executions": len(trials),
        "covering": sum(trial.origin == "covering" for trial in trials),
    }


# The stored campaigns


def name_of(family: str, dimension: int) -> str:
    """Return the name of the file that campaigns are stored in."""
    return f"decided-{family}-{dimension}d"


def missing(campaigns: int) -> list[Decision]:
    """Return the campaigns that are not stored."""
    asked = list(wanted(campaigns))
    names = {(one.family, one.dimension) for one in asked}
    known = {name: {_key(line) for line in lines(name_of(*name))} for name in names}
    return [one for one in asked if (one.search, one.share, one.seed) not in known[one.family, one.dimension]]


def _key(line: dict[str, Any]) -> tuple[str, float, int]:
    return line["search"], line["share"], line["seed"]


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=16, help="for each family in one dimension; fewer in two")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    for one, result in all_of(decide, missing(arguments.campaigns), arguments.workers):
        append(name_of(one.family, one.dimension), result)


if __name__ == "__main__":
    main()
