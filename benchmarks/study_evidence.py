"""How campaigns end on systems whose evidence is easily forgotten, and on regular ones with noise or dry friction.

``python benchmarks/study_evidence.py`` runs what is not stored yet, in the order of the groups, and prints a table,
which ``reliability.py`` writes into ``docs/reliability.md``. A `validated` of the first three groups is false.
"""

from __future__ import annotations

import argparse
import functools
import time
import warnings
from typing import Any

import numpy as np

import calibrate_noise
import notched_systems
import study_friction
from calibrate import RESULTS
from ctxval import Campaign
from ctxval._util.arrays import single_threaded
from friction_systems import SYSTEMS as FRICTION
from json_lines import JsonLines

SYSTEMS = {**FRICTION, **notched_systems.SYSTEMS}
STORED = JsonLines(RESULTS / "evidence.jsonl", ("group", "system", "seed", "share"))
BUDGET = 25
REGULAR = tuple(
    f"{plant}/{imperfection}"
    for plant in ("arm", "cart-pole", "chain", "maglev", "quadrotor", "ship", "tanks")
    for imperfection in ("process 0.5 %", "measurement 0.5 %")
)
RUBBING = ("cylinder", "rotary-seal", "geared-pendulum", "loaded-gear", "lip-seal", "ball-screw")
GROUPS: dict[str, tuple[float, tuple[str, ...]]] = {
    "effects of an execution, rare events": (0.9, ("wet/none", "bump/none", "zeroed/none", "battery/none")),
    "gain or load in some tasks": (0.9, ("weak/none", "payload/none")),
    "friction at rest by place": (0.95, ("detent-rail", "notched-hinge")),
    "regular, with noise": (1.25, REGULAR),
    "regular, with dry friction": (1.25, RUBBING),
}
"""The threshold of each group as a share of the truth, and its systems."""


@functools.cache
def truth(system: str) -> float:
    """Return the largest distance, of noisy systems its 0.9 quantile."""
    if system in SYSTEMS:
        validation = SYSTEMS[system]().validation
        tasks = validation.space.iid(study_friction.TASKS, np.random.default_rng(7))
        return float(validation.distances(tasks).max())
    plant, imperfection = system.split("/")
    return float(calibrate_noise.TRUTHS[plant, imperfection]["distance"])


def decide(group: str, system: str, seed: int) -> dict[str, Any]:
    """Return what is stored of one campaign."""
    share, started = GROUPS[group][0], time.process_time()
    threshold = share * truth(system)
    if system in SYSTEMS:
        validation = SYSTEMS[system]().validation
    else:
        plant, imperfection = system.split("/")
        validation = calibrate_noise.ALL[plant](imperfection, seed + 1).validation
    with single_threaded(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        campaign = Campaign(validation, seed=seed).run(BUDGET, threshold, thinking=np.inf)
        verdict = campaign.verdict(threshold)
    return {
        "group": group,
        "system": system,
        "seed": seed,
        "share": share,
        "answer": verdict.answer,
        "executions": campaign.executions,
        "above": sum((trial.distance or 0.0) > threshold for trial in campaign.trials),
        "bound": None if verdict.bound is None else verdict.bound / truth(system),
        "reason": verdict.reason[:300],
        "seconds": round(time.process_time() - started, 1),
    }


def before(system: str, seed: int, share: float) -> dict[str, Any] | None:
    """Return the stored campaign of the version before; None if there is none."""
    if "/" not in system:
        known = study_friction.STORED.select(system=system, share=share, seed=seed, looked_for=True)
        return next(iter(known), None)
    plant, imperfection = system.split("/")
    same = {"plant": plant, "imperfection": imperfection, "seed": seed, "share": share}
    return next(iter(calibrate_noise.STORED.select(rule=calibrate_noise.RULE, **same)), None)


HEADER = [
    *("group", "threshold", "campaigns", "validated", "of these, no execution above it", "falsified", "undecided"),
    *("executions if validated", "bound / truth", "version before: validated, executions"),
]


def rows() -> list[list[str]]:
    """Return how the campaigns of each group ended."""
    found = []

    def middle(values: list[float]) -> str:
        low, half, high = np.quantile(values, [0.0, 0.5, 1.0]) if values else (np.nan,) * 3
        return f"{half:.3g} ({low:.3g} to {high:.3g})" if values else "-"

    for group, (share, systems) in GROUPS.items():
        lines = [row for row in STORED.select(group=group) if row["system"] in systems]
        validated = [row for row in lines if row["answer"] == "validated"]
        unseen = sum(row["above"] == 0 for row in validated)
        counts = [sum(row["answer"] == answer for row in lines) for answer in ("falsified", "undecided")]
        pairs = [(row, old) for row in lines if (old := before(row["system"], row["seed"], share))]
        old = [old["executions"] for _, old in pairs if old["answer"] == "validated"]
        compared = f"{len(old)} of {len(pairs)}, {middle(old)}" if pairs else "-"
        executions, bounds = ([row[key] for row in validated] for key in ("executions", "bound"))
        cells = [group, f"{share:g}", len(lines), len(validated), unseen, *counts, middle(executions), middle(bounds)]
        found.append([*map(str, cells), compared])
    return found


def main() -> None:
    """Run the campaigns that are not stored, and print how they ended."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--groups", nargs="*", default=list(GROUPS))
    given = parser.parse_args()
    known = set(STORED)
    for seed in range(given.seeds):
        for group in given.groups:
            share, systems = GROUPS[group]
            for system in systems:
                if (group, system, seed, share) not in known:
                    STORED.append(decide(group, system, seed))
    for row in rows():
        print(*row, sep=" | ")


if __name__ == "__main__":
    main()
