"""The measured part of ``docs/how-to/watch.md``, from what ``study_watch.py`` has stored. Nothing is run here."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from study_watch import DRIFT, FALSE_ALARMS, HEAVIER, IMPERFECT, MARGIN, PATIENCE, REPEATS, STORED
from watch_systems import DEVELOPMENT, REPORTING, Watched

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "watch.md"
MARK = "<!-- written by benchmarks/watch_page.py -->\n"

HEADER = (
    "system: what becomes heavier", "noise", "certified runs", "d* then, of tau", "tasks until noticed: median (most)",
    "drifts noticed before d* > tau; after so many tasks (median)", "false alarms",
)  # fmt: skip

SECTION = """
`make watch` computes this part. A campaign of each system validates its model for a threshold of {margin:g} times the
largest distance, as it is without the change. Then random tasks are executed: on a system whose payload is {heavier} %
heavier ({repeats} repeats), on one whose payload drifts over {tasks_of_drift} tasks until the largest distance exceeds
the threshold, and on one that has not changed. The rate of false alarms is {false_alarms:g}. Noise is in shares of the
range of each state, in each step. All rules were chosen on the systems of the second table.

**Not used for any choice** ({systems} systems, {cells} cells): a payload {heavier} % heavier is noticed after {noticed}
tasks in the median over all repeats, and in {within} of {cells} cells the median is at most 3. {before} of {drifts}
drifts are noticed before any task has a distance above the threshold. In {tasks:,} tasks in which nothing has changed,
there were {alarms} false alarms: at most {upper:.1f} in 1,000 with 95 % confidence if tasks are independent, but those
of one cell share its certified runs.

{{reporting}}

**Used for choices:**

{{development}}

What noise hides takes longer. A change is noticed soon if it moves the residuals of a run by more than noise does in a
whole run, and a load that is {heavier} % heavier need not do so. A watch that has seen nothing yet needs two tasks at
least, unless a distance exceeds the threshold: that is a fact, and one task is enough.
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
    found = totals("reporting")
    text = SECTION.format(
        margin=MARGIN,
        heavier=round(100 * (HEAVIER - 1)),
        repeats=REPEATS,
        tasks_of_drift=DRIFT,
        false_alarms=FALSE_ALARMS,
        systems=len({cell["system"] for cell in STORED.select(of="reporting", part="payload")}),
        noticed=_shown(found["median"]),
        **found,
    )
    paragraphs = [
        textwrap.fill(part, 120, break_long_words=False, break_on_hyphens=False) for part in text.split("\n\n")
    ]
    whole = "\n\n".join(paragraphs)
    return whole.replace("{reporting}", table(REPORTING)).replace("{development}", table(DEVELOPMENT))


def main() -> None:
    before = PAGE.read_text().partition(MARK)[0]
    PAGE.write_text(f"{before}{MARK}\n{section().strip()}\n")
    print(f"{PAGE} has been written")


if __name__ == "__main__":
    main()
