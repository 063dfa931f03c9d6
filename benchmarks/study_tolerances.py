"""Is a validation false more often if it survives a small push only? Development half of the systems of strangers.

A validation could be called fragile if the smallest push that would bring some task above the threshold is smaller than
the largest residual that was recorded. That helps if true validations survive more than false ones. True ones are those
of regular systems at 1.25 d*. False ones are scarce with tests at drawn tasks, so misleading systems at 0.95 d* are run
without tests. Of each validation, the tolerances at other thresholds follow from the same pushes.
``python benchmarks/study_tolerances.py`` runs what is not stored yet, and prints a table.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from calibrate_strangers import BUDGET
from ctxval import Campaign
from ctxval._util.arrays import single_threaded
from ctxval.certificates import Automatic, CertificateOptions
from ctxval.core.learned_numbers import PushedDistances
from json_lines import JsonLines
from strangers_development import DEVELOPMENT
from study_drawn_tests import truth

TRUE, FALSE = 1.25, 0.95
"""Thresholds as shares of d*, of regular and of misleading systems."""
SHARES = {TRUE: (1.1, 1.25, 1.5), FALSE: (0.95,)}
"""Thresholds at which tolerances are compared."""

STORED = JsonLines(RESULTS / "tolerances.jsonl", ("entry", "seed"))


def decide(run: tuple[str, int]) -> dict[str, Any]:
    """Return what is stored of one campaign that was run until it was decided."""
    name, seed = run
    started, entry = time.process_time(), DEVELOPMENT[name]
    largest, share = truth(entry, seed), FALSE if entry.misleading else TRUE
    options = CertificateOptions(Automatic(tests=0)) if entry.misleading else CertificateOptions()
    with single_threaded():
        campaign = Campaign(entry(seed).validation, seed=seed).run(
            BUDGET, share * largest, certificate=options, thinking=np.inf
        )
        verdict = campaign.verdict(share * largest, certificate=options)
    details = {} if verdict.certificate is None else verdict.certificate.details
    return {
        "entry": name,
        "seed": seed,
        "share": share,
        "answer": verdict.answer,
        "executions": campaign.executions,
        "bound": None if verdict.bound is None else verdict.bound / largest,
        "ratios": ratios(details.get("pushed"), largest, SHARES[share]),
        "seconds": round(time.process_time() - started, 1),
    }


def ratios(pushed: dict[str, Any] | None, largest: float, shares: tuple[float, ...]) -> dict[str, list[float]] | None:
    """Return tolerances as multiples of the largest residual, everywhere and away from records, by threshold."""
    if pushed is None:
        return None
    distances = PushedDistances.from_json(pushed)
    pairs = {share: [distances.tolerance(share * largest, away=away) for away in (False, True)] for share in shares}
    return {str(share): [min(each.ratio, 99.0) for each in pair] for share, pair in pairs.items()}


def rows() -> list[list[str]]:
    """Return a table: how many validations survive less than the largest residual, at each threshold."""
    lines = [line for line in STORED.values() if line["answer"] == "validated" and line["ratios"] is not None]
    cells = []
    for share in (*SHARES[FALSE], *SHARES[TRUE]):
        pairs = [line["ratios"][str(share)] for line in lines if str(share) in line["ratios"]]
        for place, where in enumerate(("everywhere", "away from records")):
            values = [pair[place] for pair in pairs]
            median = f"{np.median(values):.2g}" if values else "-"
            cells.append([f"{share:g}", where, f"{sum(value < 1 for value in values)} of {len(values)}", median])
    return cells


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(DEVELOPMENT))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    runs = [(name, seed) for seed in range(options.seeds) for name in options.names]
    for result in all_of(decide, [run for run in runs if run not in STORED], options.workers):
        STORED.append(result)
        print(*(result[key] for key in ("entry", "seed", "answer", "executions", "ratios", "seconds")), flush=True)
    print("tau / d*", "push", "less than the largest residual", "median", sep=" | ")
    for row in rows():
        print(*row, sep=" | ")


if __name__ == "__main__":
    main()
