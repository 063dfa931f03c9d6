"""How often is `validated` false on systems that nobody tuned to? Campaigns as a user runs them, until decided.

``python benchmarks/calibrate_strangers.py reporting`` runs what is not stored yet and prints a table by family. Each
campaign has the default certificate and search, and a threshold of a known share of d*. Rules may be chosen on the
development half of ``strangers_development.py`` alone.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from typing import Any

from calibrate import RESULTS, all_of
from ctxval import Campaign
from ctxval._util.arrays import single_threaded
from ctxval.certificates.sentences.verdicts import tolerances
from dynamics_truths import digest
from json_lines import JsonLines
from strangers_development import DEVELOPMENT
from strangers_diagnostics import JudgedRun
from strangers_reporting import REPORTING
from strangers_truths import SEEDS, TRUTHS

RULE = 11
"""Version of the rule by which campaigns are run: 11 tests twice as often if M ignores a task parameter, of which tasks
are no new ones by its value alone, so that only campaigns of systems with such a parameter differ from 10, and the
others have its number; 10 spreads the values of parameters that change no prediction, so that only campaigns of systems
with such parameters differ from 9, and the others have its number; 9 looks beside a failed test only if what is learned
does not explain it by now, so that only campaigns with drawn tests differ from 8, and the others have its number; 8
enters places of positions after the tests, so that only campaigns of systems with positions that are validated differ
from 7; 7 executes the corners of positions, so that those of systems without positions are as by rule 6; 5 tests again
after a test that failed, if what is learned explains it by now; 4 finds task parameters that change the dynamics, and
leaves out data of M that contradict the executions; 3 learns histories and noise; tests are points of a hypercube."""

BUDGET = 25
FALSE, TRUE = (0.8, 0.95, 0.99), (1.1, 1.25, 1.5)
"""Thresholds as shares of d*: those that must not be validated, and those that should be on regular systems."""

HALVES = {"development": DEVELOPMENT, "reporting": REPORTING}
ENTRIES = {**DEVELOPMENT, **REPORTING}
STORED = JsonLines(RESULTS / "strangers.jsonl", ("rule", "entry", "seed", "share"))


def decide(run: tuple[str, int, float]) -> dict[str, Any]:
    """Return what is stored of one campaign that was run until it was decided."""
    name, seed, share = run
    started, entry = time.process_time(), ENTRIES[name]
    largest = TRUTHS[name, seed, digest(entry.make)]["distance"]
    with single_threaded():
        campaign = Campaign(entry(seed).validation, seed=seed)
        stopped = JudgedRun(campaign, share * largest).run(BUDGET)
        verdict = campaign.verdict(share * largest)
    known = None if verdict.certificate is None else tolerances(verdict.certificate, share * largest)
    return {
        "rule": RULE,
        "entry": name,
        "seed": seed,
        "share": share,
        "answer": verdict.answer,
        "executions": campaign.executions,
        "origins": [trial.origin for trial in campaign.trials],
        "largest": max(trial.distance or 0.0 for trial in campaign.trials) / largest,
        "kind": None if verdict.certificate is None else verdict.certificate.kind,
        "bound": None if verdict.bound is None else verdict.bound / largest,
        "reason": verdict.reason[:300],
        "stopped": stopped,
        "tolerances": None if known is None else [tolerance.ratio for tolerance in known],
        "seconds": round(time.process_time() - started, 1),
    }


def table(half: str) -> str:
    """Return how many campaigns of each family were validated, of those with thresholds below and above d*."""
    lines = [
        "| family | below d*: validated, falsified, undecided | above d*, regular: validated of |",
        "|---|---|---|",
    ]
    of_half = [line for line in STORED.select(rule=RULE) if line["entry"] in HALVES[half]]
    for family in sorted({entry.family for entry in HALVES[half].values()}):
        lines.append(_row(family, [line for line in of_half if ENTRIES[line["entry"]].family == family]))
    return "\n".join([*lines, _row("all", of_half)])


def _row(family: str, results: list[dict[str, Any]]) -> str:
    below = Counter(line["answer"] for line in results if line["share"] < 1)
    regular = [line["answer"] for line in results if line["share"] > 1 and not ENTRIES[line["entry"]].misleading]
    counts = ", ".join(str(below[answer]) for answer in ("validated", "falsified", "undecided"))
    return f"| {family} | {counts} | {regular.count('validated')} of {len(regular)} |"


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("half", choices=HALVES)
    parser.add_argument("--seeds", type=int, help=f"{SEEDS} if it is not given")
    parser.add_argument("--shares", nargs="*", type=float, default=[*FALSE, *TRUE])
    parser.add_argument("--regular", action="store_true", help="only systems for which the assumptions hold")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    runs = [
        (name, seed, share)
        for seed in range(options.seeds or SEEDS[options.half])
        for share in options.shares
        for name in HALVES[options.half]
        if not (options.regular and ENTRIES[name].misleading)
    ]
    for result in all_of(decide, [run for run in runs if (RULE, *run) not in STORED], options.workers):
        STORED.append(result)
        print(*(result[key] for key in ("entry", "seed", "share", "answer", "executions", "seconds")), flush=True)
    print(table(options.half))


if __name__ == "__main__":
    main()
