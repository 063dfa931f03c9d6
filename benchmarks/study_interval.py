"""What a campaign without a threshold costs, and whether its interval holds d*: runs that end when it is narrow.

``python benchmarks/study_interval.py`` runs what is not stored yet, on the reporting systems of
``dynamics_reporting.py``, with which nothing was chosen.
"""

from __future__ import annotations

import time
from itertools import product
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from ctxval import Campaign
from ctxval._util.arrays import single_threaded
from ctxval.campaign.dynamics import NEAR
from ctxval.errors import CertificateError
from dynamics_reporting import REPORTING
from dynamics_truths import truth
from json_lines import JsonLines

BUDGET, SEEDS = 12, 2
STORED = JsonLines(RESULTS / "interval.jsonl", ("entry", "seed"))


def study(one: tuple[int, str]) -> dict[str, Any]:
    """Return the interval at the end of a campaign, as shares of d*, and how many executions were copies."""
    seed, entry = one
    started, largest = time.process_time(), float(truth(REPORTING[entry], seed)["distance"])
    with single_threaded():
        campaign = Campaign(REPORTING[entry](seed).validation, seed=seed).run(BUDGET, thinking=np.inf)
        try:
            bound = campaign.certify().bound
        except CertificateError:
            bound = None
    points = np.array([trial.unit_point for trial in campaign.trials])
    copies = [np.abs(points[:k] - points[k]).max(axis=1).min() <= NEAR for k in range(1, len(points))]
    return {
        "entry": entry,
        "seed": seed,
        "executions": campaign.executions,
        "ended": campaign.executions < BUDGET,
        "largest": (campaign.estimate or 0.0) / largest,
        "bound": None if bound is None else bound / largest,
        "copies": int(np.sum(copies)),
        "seconds": round(time.process_time() - started, 1),
    }


def rows() -> list[list[str]]:
    """Return a row of the table for each system: how many ended, executions, and the interval as shares of d*."""
    found = []
    for entry in dict.fromkeys(line["entry"] for line in STORED.values()):
        lines = STORED.select(entry=entry)
        ended = [line for line in lines if line["ended"]]
        name = f"{entry} (misleading)" if REPORTING[entry].misleading else entry
        lower, upper = (min((line[key] for line in ended), default=None) for key in ("largest", "bound"))
        executions = ", ".join(str(line["executions"]) for line in lines)
        shown = ["-" if value is None else f"{value:.4f}" for value in (lower, upper)]
        found.append([name, f"{len(ended)} of {len(lines)}", executions, *shown, str(sum(k["copies"] for k in lines))])
    return found


def main() -> None:
    """Run all campaigns that are not stored."""
    left = [(seed, entry) for seed, entry in product(range(SEEDS), REPORTING) if (entry, seed) not in STORED]
    for line in all_of(study, left, workers=2):
        STORED.append(line)
        print(*line.values(), flush=True)


if __name__ == "__main__":
    main()
