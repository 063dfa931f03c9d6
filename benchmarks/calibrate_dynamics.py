"""How often is `validated` by learned dynamics false, and what does it cost? Campaigns that run until they are decided.

``python benchmarks/calibrate_dynamics.py`` runs what is not stored yet. Each campaign is given a threshold of a known
share of d*. The systems of ``dynamics_reporting.py`` were written down before any of them was run, and no threshold of
the certificate was chosen with them. A stored line of an earlier rule is not used.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import study_auto
from calibrate import RESULTS, all_of
from ctxval import Campaign
from ctxval._util.arrays import single_threaded
from ctxval.certificates import Certificate, CertificateOptions, Dynamics
from dynamics_development import DEVELOPMENT, PAPER
from dynamics_reporting import REPORTING
from dynamics_rough import ROUGH
from dynamics_truths import truth
from json_lines import JsonLines

RULE = 8
"""Version of the rule by which campaigns are run now: eight tests at drawn tasks come before a validation (5), and the
corners of positions are executed (6), places of positions are entered after the tests (7), and numbers such as x and y
are a position (8). Campaigns of systems without such positions are the same, and so are falsified ones by 6 and 7; they
have the newer number."""

WITH_TESTS = 5  # the first rule with tests at drawn tasks

BUDGETS = {"reporting": 20, "rough": 20, "paper": 24, "development": 20}
"""Largest numbers of executions."""

FALSE, TRUE = (0.95, 0.99), (1.1, 1.25)
"""Thresholds as shares of d*: those that must not be validated, and those that should be."""

SEEDS, FEW = 10, 5
"""Numbers of seeds at 0.95 and 1.1, and at 0.99 and 1.25."""

GROUPS = {"reporting": REPORTING, "rough": ROUGH, "paper": PAPER, "development": DEVELOPMENT}
"""Systems; the first two groups had no part in the choice of the rule."""


@dataclass(frozen=True)
class Run:
    """One campaign, fully said by its fields."""

    group: str
    entry: str
    seed: int
    share: float


def wanted(group: str, seeds: int = SEEDS) -> Iterator[Run]:
    """Yield the campaigns of a group, those of seed 0 first."""
    for seed in range(min(seeds, FEW) if group == "rough" else seeds):
        for entry in GROUPS[group]:
            for share in (FALSE[0], TRUE[0], *((FALSE[1], TRUE[1]) if seed < FEW else ())):
                yield Run(group, entry, seed, share)


def decide(one: Run) -> dict[str, Any]:
    """Run one campaign until it is decided; return what is stored of it."""
    started = time.process_time()
    validation, largest = GROUPS[one.group][one.entry](one.seed).validation, _largest(one)
    threshold = one.share * largest
    options = CertificateOptions(Dynamics())
    with single_threaded():
        campaign = Campaign(validation, seed=one.seed)
        campaign.run(BUDGETS[one.group], threshold, certificate=options, thinking=float("inf"))
        verdict = campaign.verdict(threshold, certificate=options)
    return {
        "rule": RULE,
        **dataclasses.asdict(one),
        "answer": verdict.answer,
        "executions": campaign.executions,
        "largest": max(trial.distance or 0.0 for trial in campaign.trials) / largest,
        **_summary(verdict.certificate, largest),
        "reason": verdict.reason[:300],
        "seconds": round(time.process_time() - started, 1),
    }


def _largest(one: Run) -> float:
    """Return d*; of a case of the paper the larger of two stored searches, as each of them has missed a maximum."""
    if one.group == "paper":
        campaign = study_auto.results_of("auto")[one.entry, one.seed, "auto"]["truth"]
        searched = [line["found"] for line in GLOBAL_SEARCHES.select(case=one.entry, seed=one.seed)]
        return float(max([campaign, *searched]))
    return float(truth(GROUPS[one.group][one.entry], one.seed)["distance"])


def _summary(found: Certificate | None, largest: float) -> dict[str, Any]:
    if found is None or found.kind != "dynamics":
        return {}
    details = found.details
    return {
        "bound": found.upper_bound / largest,
        "evaluations": details["evaluations"],
        "gap": details["coverage_gap"],
        "beyond": details["beyond_the_records"],
        "held": [bool(prediction["held"]) for prediction in details["checked"]],
        "noise": details["noise"],
        "left_out": details["variance_left_out"],
    }


GLOBAL_SEARCHES = JsonLines(RESULTS / "global_search.jsonl", ("case", "seed", "evaluations"))
STORED = JsonLines(RESULTS / "calibrate_dynamics.jsonl", ("rule", *(field.name for field in dataclasses.fields(Run))))


def missing(groups: list[str], seeds: int) -> list[Run]:
    """Return the campaigns that are not stored."""
    every = [one for group in groups for one in wanted(group, seeds)]
    return [one for one in every if (RULE, *dataclasses.astuple(one)) not in STORED]


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("groups", nargs="*", default=list(GROUPS), help=", ".join(GROUPS))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--shares", nargs="*", type=float, default=[*FALSE, *TRUE], help="thresholds, as shares of d*")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    runs = [one for one in missing(arguments.groups, arguments.seeds) if one.share in arguments.shares]
    for result in all_of(decide, runs, arguments.workers):
        STORED.append(result)
        print(*(result[key] for key in ("entry", "seed", "share", "answer", "executions", "seconds")), flush=True)


if __name__ == "__main__":
    main()
