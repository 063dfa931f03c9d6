"""The part of ``docs/calibration.md`` on verdicts under noise, and its picture. Nothing is run here."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binom, chisquare

from calibrate import ROOT
from calibrate_noise import BUDGET, CONFIDENCES, HALVES, IMPERFECTIONS, QUANTILE, RULE, STORED, table
from calibration_verdicts_part import interval, validated_share
from ctxval._util.arrays import Array
from ctxval.certificates.prediction_tests import DRAWN

PICTURE, BINS = ROOT / "docs" / "calibration" / "noise_ranks.png", 10

TEXT = """## Noise

{plants} plants have noise, encoders, late commands or slow actuators, in the shares of their ranges and in the steps
that the table names ([noise](explanation/noise.md)). They were never tuned on. A threshold is a share of the largest
{quantile:g} quantile of the distance, d_q*. Campaigns run with the default certificate, eight tests and at most
{budget} executions until they are decided. {count} campaigns are stored.

**At 0.95 d_q*, {false} of {below} campaigns were validated falsely (the 95 % interval is {low:.1f} to {high:.1f} %).**

{reported}

Bounds of the posterior samples alone, at the end of the campaigns, without the tests and diagnostics that a verdict
needs beside them: how many are at least d_q*.

{coverage}

Before each execution, noisy dynamics predict with which probability its distance is smaller than each value. With the
right law, the probabilities of what was executed are uniform. They can be so only where nobody chose the task by its
prediction: of tasks that were chosen because a large distance was predicted, the chosen predictions are too large. The
picture has both.

{ranks}

![How often each tenth of the predicted probabilities was met, beside chance](calibration/noise_ranks.png)

{developed}{misleading}"""

DEVELOPED = """
On plants on which rules were chosen:

{table}
"""

MISLEADING = """
On carts that break an assumption; eight of them were looked at during development, dropouts and battery were not:

{table}

The two validations are false. In payload, the load lies in a tenth of the goals, 0.8 to 1.2 m, and no executed task
had such a goal. In sticking, the wheels stop in nearly every task where the push is too weak, at 0.82 to 0.86 of
d_q*, and the worst tasks lie in a small place.
"""


def under_noise() -> str:
    """Return the part; without campaigns it is empty."""
    stored = STORED.select(rule=RULE)
    results = [line for line in stored if line["plant"] in HALVES["reporting"]]
    if not results:
        return ""
    below = [line["answer"] for line in results if line["share"] == 0.95]

    def of(half: str, text: str) -> str:
        return text.format(table=table(half)) if any(line["plant"] in HALVES[half] for line in stored) else ""

    return TEXT.format(
        plants=len(HALVES["reporting"]),
        quantile=QUANTILE,
        budget=BUDGET,
        count=len(results),
        **validated_share(below),
        reported=table("reporting"),
        coverage=_coverage(results),
        ranks=_uniform(results),
        developed=of("development", DEVELOPED),
        misleading=of("misleading", MISLEADING),
    )


def _coverage(results: Sequence[dict[str, Any]]) -> str:
    """Return how many bounds of each confidence hold, with noise and without it."""
    lines = [f"| | {' | '.join(f'{each:.0%}' for each in CONFIDENCES)} |", "|---|" + "---|" * len(CONFIDENCES)]
    for name, kinds in _kinds().items():
        bounds = [line["bounds"] for line in results if line["imperfection"] in kinds and line["bounds"] is not None]
        cells = []
        for confidence in CONFIDENCES if bounds else ():
            held = sum(each[str(confidence)] >= 1 - 1e-6 for each in bounds)
            low, high = interval(len(bounds) - held, len(bounds))
            cells.append(f"{held} of {len(bounds)} ({low:.0f} to {high:.0f} %)")
        if cells:
            lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _kinds() -> dict[str, list[str]]:
    late = [name for name in IMPERFECTIONS if name.startswith(("delay", "lag"))]
    noisy = [name for name in IMPERFECTIONS if name not in ("none", *late)]
    return {"no imperfection": ["none"], "delays and lags": late, "noise and encoders": noisy}


NOISES = ("process", "measurement", "both", "encoder")


def _ranks(results: Sequence[dict[str, Any]], noise: str) -> tuple[Array, Array]:
    """Return the predicted probabilities of less, of drawn tests and of tasks that were chosen."""
    drawn, chosen = [], []
    for line in results:
        if line["imperfection"].startswith(noise) and None not in line["distances"]:
            # Once a prediction knows noise, all later ones do.
            origins = line["origins"][len(line["origins"]) - len(line["ranks"]) :]
            for origin, rank in zip(origins, line["ranks"], strict=True):
                (drawn if origin in DRAWN else chosen).append(rank)
    return np.array(drawn), np.array(chosen)


def _uniform(results: Sequence[dict[str, Any]]) -> str:
    """Return what a test of fit says of drawn tests, and how often chosen tasks are in the lowest tenth."""
    tests, lowest = [], []
    for noise in NOISES:
        drawn, chosen = _ranks(results, noise)
        if len(drawn):
            probability = chisquare(np.histogram(drawn, BINS, (0, 1))[0]).pvalue
            tests.append(f"{noise} {probability:.2g} ({len(drawn)} executions)")
        if len(chosen):
            lowest.append(f"{noise} {(chosen < 1 / BINS).mean() * BINS:.1f}")
    text = (
        "At drawn tests, the probability of ranks that are less uniform, if the law is right, is by noise: "
        f"{', '.join(tests)}. Chosen tasks fall into the lowest tenth more often than one time in ten, by a factor "
        f"of: {', '.join(lowest)}. After measurement noise, distances are more rarely far above what was predicted "
        "than they should be, so its predictions err on the safe side."
    )
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def draw() -> None:
    """Draw how often each tenth of the predicted probabilities was met on reporting plants, by kind of noise."""
    stored = [line for line in STORED.select(rule=RULE) if line["plant"] in HALVES["reporting"]]
    figure = Figure(figsize=(10, 2.9), layout="constrained")
    panels = figure.subplots(1, len(NOISES), sharey=True)
    for panel, noise in zip(panels, NOISES, strict=True):
        drawn, chosen = _ranks(stored, noise)
        panel.set(title=f"{noise}\n{len(drawn):,} drawn, {len(chosen):,} chosen", xlim=(0, 1))
        panel.set_xlabel("predicted probability of less")
        if not len(drawn):
            continue
        low, high = binom.interval(0.95, len(drawn), 1 / BINS)
        panel.axhspan(low * BINS / len(drawn), high * BINS / len(drawn), color="0.88", label="95 % of chance, drawn")
        panel.axhline(1.0, color="0.4", linewidth=1)
        for ranks, style in (
            (drawn, {"color": "#0072b2", "linewidth": 1.8, "label": "drawn tests"}),
            (chosen, {"color": "#d55e00", "linewidth": 1.2, "linestyle": "--", "label": "chosen tasks"}),
        ):
            density, edges = np.histogram(ranks, bins=BINS, range=(0, 1), density=True)
            panel.stairs(density, edges, **style)
    panels[0].set_ylabel("share, relative to uniform")
    panels[0].legend(loc="upper right", frameon=False, fontsize=8)
    figure.savefig(PICTURE, dpi=110)
