"""The measured part of ``docs/how-to/watch.md``, from what ``study_watch.py`` has stored. Nothing is run here."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from study_watch import DRIFT, FALSE_ALARMS, HEAVIER, IMPERFECT, MARGIN, PATIENCE, STORED
from watch_systems import DEVELOPMENT, REPORTING, Watched

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "watch.md"
MARK = "<!-- written by benchmarks/watch_page.py -->\n"

HEADER = (
    "system: what becomes heavier", "noise", "certified runs", "d* then, of tau", "tasks until noticed: median (most)",
    "drifts noticed before d* > tau; after so many tasks (median)", "false alarms",
)  # fmt: skip

SECTION = """
## Measured

`make watch` computes this part and prints its tables. Campaigns validate models for {margin:g} times their largest
distance. On {systems} systems that were not used for any choice ({cells} cells with and without noise), a payload that
is {heavier} % heavier is noticed after {median:g} tasks in the median, and {before} of {drifts} drifts over
{tasks_of_drift} tasks are noticed before any distance exceeds the threshold. {tasks:,} tasks without a change gave
{alarms} false alarms, at a stated rate of {false_alarms:g}. Larger noise hides a change for longer: a cart with
measurement noise of 0.5 % of the ranges showed its heavier payload in the median after {hidden} tasks.
"""


def median_of(delays: Sequence[int | None]) -> float:
    """Return the median delay; infinity if half of the changes were not noticed."""
    return float(np.median([math.inf if each is None else each for each in delays]))


def upper_rate(alarms: int, tasks: int) -> float:
    """Return the 95 % upper limit of the share of tasks with a false alarm (Clopper and Pearson)."""
    return float(beta.ppf(0.95, alarms + 1, tasks - alarms))


def _shown(value: float) -> str:
    return f"more than {PATIENCE}" if math.isinf(value) else f"{value:g}"


def row(name: str, watched: Watched, imperfection: str) -> list[str] | None:
    """Return the row of one cell; None if it is not complete."""
    parts = [STORED.get((name, imperfection, part)) for part in ("certified", "payload", "drift", "in control")]
    if None in parts:
        return None
    certified, payload, drift, control = (part or {} for part in parts)
    noticed, exceeded = drift["noticed"], drift["exceeded"]
    before = sum(each is not None and each < exceeded for each in noticed) if exceeded else 0
    delays = payload["delays"]
    late = max((math.inf if each is None else each for each in delays), default=math.inf)
    return [
        f"{name}: {watched.what}",
        imperfection,
        str(certified["executions"]),
        f"{100 * payload['distance']:.0f} %",
        f"{_shown(median_of(delays))} ({_shown(late)})",
        f"{before} of {len(noticed)}; {_shown(median_of(noticed))} of {exceeded}" if exceeded else "never above",
        f"{len(control['alarms'])} of {control['tasks']}",
    ]


def table(systems: dict[str, Watched]) -> str:
    """Return a table of all complete cells."""
    cells = ((name, watched, imperfection) for imperfection in IMPERFECT for name, watched in systems.items())
    rows = [found for cell in cells if (found := row(*cell)) is not None]
    lines = [HEADER, ["---"] * len(HEADER), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def totals(of: str) -> dict[str, Any]:
    """Return what all cells of some systems say together."""
    payload, drift, control = (STORED.select(of=of, part=part) for part in ("payload", "drift", "in control"))
    delays = [each for cell in payload for each in cell["delays"]]
    noticed = [(each, cell["exceeded"]) for cell in drift if cell["exceeded"] for each in cell["noticed"]]
    tasks, alarms = sum(cell["tasks"] for cell in control), sum(len(cell["alarms"]) for cell in control)
    return {
        "cells": len(payload),
        "within": sum(median_of(cell["delays"]) <= 3 for cell in payload),
        "median": median_of(delays),
        "drifts": len(noticed),
        "before": sum(each is not None and each < exceeded for each, exceeded in noticed),
        "tasks": tasks,
        "alarms": alarms,
        "upper": 1000 * upper_rate(alarms, tasks) if tasks else math.nan,
    }


def section() -> str:
    """Return the measured part of the page."""
    found, hidden = totals("reporting"), STORED.get(("cart", "measurement 0.5 %", "payload")) or {"delays": []}
    text = SECTION.format(
        margin=MARGIN,
        heavier=round(100 * (HEAVIER - 1)),
        tasks_of_drift=DRIFT,
        false_alarms=FALSE_ALARMS,
        systems=len({cell["system"] for cell in STORED.select(of="reporting", part="payload")}),
        hidden=_shown(median_of(hidden["delays"])),
        **found,
    )
    return "\n\n".join(
        textwrap.fill(part, 120, break_long_words=False, break_on_hyphens=False) for part in text.split("\n\n")
    )


def main() -> None:
    before = PAGE.read_text().partition(MARK)[0]
    PAGE.write_text(f"{before}{MARK}\n{section().strip()}\n")
    print(table(REPORTING), table(DEVELOPMENT), f"{PAGE} has been written", sep="\n\n")


if __name__ == "__main__":
    main()
