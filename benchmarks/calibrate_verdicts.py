"""How often is `validated` false, and what does a verdict cost? Campaigns that run until they are decided.

``python benchmarks/calibrate_verdicts.py`` runs what is not stored yet. Each campaign is given a threshold of a known
share of d*: 0.95, which must not be validated, or 1.1, which should be, and runs as ``ctxval run`` does. Stored
lines with ``rule`` 1 are from before corners were asked for and bounds were put to the test.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibrate import FAMILIES, REPRODUCED, RESULTS, SYSTEMS, Values, all_of, maximum
from calibration_functions import DEVELOPMENT, REPORTING, generator
from ctxval import Campaign, Trial, cases
from ctxval._util.arrays import Array, single_threaded
from ctxval.certificates import RESOLUTION, CertificateOptions, DistanceBound, StoppingRule, covering
from ctxval.certificates.verdict import counterexample
from json_lines import JsonLines
from named_searches import search_named
from reproduce.jobs import Job, Results

RULE = 2
"""Of coverage, by which campaigns are run now."""

HARD = ("corner cusp", "plateau with a ridge", "chirp", "narrow peaks", "bifurcation")
"""Families that the rule was chosen by, of which most verdicts were false before."""

FRESH = 100
"""The first seed of functions of theirs that it was not chosen by."""

BUDGETS = {1: 30, 2: 60, 3: 130}
"""Executions at most; in four dimensions no such budget comes near to every task."""

LOTS = {1: 1, 2: 4, 3: 8}
"""Executions of tasks that nothing came near to between two questions whether the bound still keeps the threshold, as
with so many workers: in functions of more dimensions there are dozens of them, and each question costs seconds."""

ENDED_EARLY = (3,)
"""Dimensions in which a campaign ends as undecided as soon as the budget is too small to come near to every task."""

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
    yield from _functions(SHARES[0], tuple(REPORTING), (1, 2), range(campaigns))
    yield from _functions(SHARES[0], tuple(REPORTING), (3,), range(max(1, campaigns // 3)))
    yield from _functions(SHARES[0], HARD, (1, 2), range(FRESH, FRESH + campaigns))
    for seed in range(10):
        for share in SHARES:
            yield from (Decision(name, SYSTEMS[name].dimension, "auto", share, seed) for name in DRIVEN)
    yield from _functions(SHARES[1], tuple(REPORTING), (1, 2), range(min(2, campaigns)))


def _functions(
    share: float, families: tuple[str, ...], dimensions: tuple[int, ...], seeds: range
) -> Iterator[Decision]:
    for seed in seeds:
        for d in dimensions:
            yield from (Decision(family, d, search, share, seed) for family in families for search in SEARCHES)


def decide(one: Decision) -> dict[str, Any]:
    """Run one campaign until it is decided; return what is stored of it."""
    with single_threaded():
        result = _of_system(one) if one.family in SYSTEMS else _of_function(one)
    return {"rule": RULE, **dataclasses.asdict(one), **result}


def function(one: Decision) -> Values:
    """Return the function that a campaign is about."""
    if one.family in FAMILIES:
        rng = np.random.default_rng([one.seed, one.dimension, sorted(FAMILIES).index(one.family)])
        return FAMILIES[one.family][0](one.dimension, rng)
    return (DEVELOPMENT | REPORTING)[one.family](one.dimension, generator(one.family, one.dimension, one.seed))


def _of_function(one: Decision) -> dict[str, Any]:
    values = function(one)
    # A distance is not negative.
    lowest = float(values(np.random.default_rng(0).random((2000, one.dimension))).min())
    threshold, budget = one.share * (maximum(values, one.dimension) - lowest), BUDGETS[one.dimension]
    search = search_named(one.search)
    search.reset(one.dimension, one.seed)
    rule = StoppingRule(threshold)
    trials: list[Trial] = []
    while len(trials) < budget:
        if one.dimension in ENDED_EARLY and _is_out_of_reach(trials, budget):
            return _summary(trials, threshold, decided=False)
        now = rule.decide(trials, budget - len(trials))
        if now.decided:
            return _summary(trials, threshold, decided=True)
        points = search.ask() if now.next_point is None else _lot(trials, now.next_point, budget)
        for point in points:
            distance = max(0.0, float(values(point[None])[0]) - lowest)
            search.tell(point[None], [distance])
            trials.append(_trial(len(trials), "acquisition" if now.next_point is None else "covering", point, distance))
            if distance > threshold:
                break
    return _summary(trials, threshold, decided=rule.decide(trials, 0).decided)


def _is_out_of_reach(trials: list[Trial], budget: int) -> bool:
    points = np.array([trial.unit_point for trial in trials])
    return len(trials) > 0 and covering(points, RESOLUTION, budget - len(trials)) is None


def _lot(trials: list[Trial], uncovered: Array, budget: int) -> Array:
    """Return the next tasks that nothing came near to ``(n, d)``, or, if there are none, one that tests the bound."""
    missing = covering(np.array([trial.unit_point for trial in trials]), RESOLUTION, budget - len(trials))
    return uncovered[None] if missing is None or not len(missing) else missing[: LOTS[len(uncovered)]]


def _trial(number: int, origin: Any, point: Array, distance: float) -> Trial:
    return Trial(number, origin, "completed", point, {}, 1, True, distance)


def _of_system(one: Decision) -> dict[str, Any]:
    system = SYSTEMS[one.family]
    best_known = Results(REPRODUCED)[Job("truth", system.case, one.seed, system.options)]["distance"]
    experiment = cases.by_name(system.case, one.seed, **dict(system.options))
    threshold, budget = one.share * best_known, BUDGETS[one.dimension]
    campaign = Campaign(experiment.validation, search=search_named(one.search), seed=one.seed)
    campaign.run(budget, threshold, certificate=CertificateOptions(DistanceBound()))
    return _summary(
        list(campaign.trials), threshold, decided=StoppingRule(threshold).decide(campaign.trials, 0).decided
    )


def _summary(trials: list[Trial], threshold: float, *, decided: bool) -> dict[str, Any]:
    falsified = counterexample(trials, threshold) is not None
    return {
        "answer": "falsified" if falsified else "validated" if decided else "undecided",
        "executions": len(trials),
        "covering": sum(trial.origin == "covering" for trial in trials),
    }


# The stored campaigns

STORED = JsonLines(
    RESULTS / "calibrate_verdicts.jsonl", ("rule", *(field.name for field in dataclasses.fields(Decision)))
)


def decisions(family: str, dimension: int, rule: int = RULE) -> list[dict[str, Any]]:
    """Return the stored campaigns of a family that were run by a rule of coverage."""
    return STORED.select(family=family, dimension=dimension, rule=rule)


def missing(campaigns: int) -> list[Decision]:
    """Return the campaigns that are not stored."""
    return [one for one in wanted(campaigns) if (RULE, *dataclasses.astuple(one)) not in STORED]


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--campaigns", type=int, default=10, help="for each family and search; a third in three dimensions"
    )
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    for result in all_of(decide, missing(arguments.campaigns), arguments.workers):
        STORED.append(result)


if __name__ == "__main__":
    main()
