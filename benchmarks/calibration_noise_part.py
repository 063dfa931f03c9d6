"""The part of ``docs/calibration.md`` on noise and outputs, and its picture. Nothing is run here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binom, chisquare

import calibrate_outputs
from calibrate_noise import BUDGET, CONFIDENCES, HALVES, HEADER, IMPERFECTIONS, QUANTILE, RULE, STORED, row, rows
from ctxval._util.arrays import Array
from ctxval.certificates.prediction_tests import DRAWN
from page_tables import DOCS, Table, interval, share_of, table

PICTURE, BINS = DOCS / "calibration" / "noise_ranks.png", 10

TEXT = """## Noise

{plants} plants have noise, encoders, late commands or slow actuators, in shares of their ranges and in steps
([noise](explanation/noise.md)). Nothing was tuned on them. A threshold is a share of the largest {quantile:g}
quantile of the distance, d_q*. Campaigns have at most {budget} executions; {count} are stored. **At 0.95 d_q*,
{false} were validated falsely.**

{reported}

The posterior samples alone, without tests and diagnostics, give bounds of which these are at least d_q*:

{coverage}

Noisy dynamics predict, before each execution, the probability of a smaller distance. If the law is right, these
probabilities are uniform at drawn tests. The p-values of a chi-squared test are: {uniform}. After measurement noise,
distances are more rarely far above the prediction than they should be, so its predictions err on the safe side.
Tasks that were chosen for their large prediction fall into the lowest tenth too often, as expected of such a choice:
by a factor of {lowest}.

![How often each tenth of the predicted probabilities was met, and its range by chance](calibration/noise_ranks.png)

On {misleading} carts that break an assumption, {misled} were validated falsely at 0.95 d_q*. In `payload`, the load
lies in a tenth of the goals, and no executed task had such a goal. In `sticking`, the wheels stop if the push is too
weak, and the worst tasks lie in a small place.

Tables: [by imperfection](tables/calibration-noise.csv), [carts that break an
assumption](tables/calibration-noise-misleading.csv).

## Outputs in place of states

{of_outputs} of these plants, with recorded positions and angles and no rates: the states of the models are estimated
from the outputs ([how](theory.md#dynamics-bound)), and the controllers have a Kalman filter. Nothing was tuned on
these plants. **At 0.95 d*, {false_outputs} were validated falsely** (at most {budget_outputs} executions).

{outputs}"""


def under_noise() -> tuple[str, dict[str, Table]]:
    """Return the part of the page and its tables."""
    results = [line for line in STORED.select(rule=RULE) if line["plant"] in HALVES["reporting"]]
    misled = rows("misleading")
    uniform, lowest = _uniform(results)
    outputs = calibrate_outputs.STORED.select(rule=calibrate_outputs.RULE)
    text = TEXT.format(
        plants=len(HALVES["reporting"]),
        quantile=QUANTILE,
        budget=BUDGET,
        count=len(results),
        false=false_of("reporting"),
        reported=table(["", *HEADER[1:]], _by_kind(results)),
        coverage=table(["", *(f"{each:.0%}" for each in CONFIDENCES)], _coverage(results)),
        uniform=uniform,
        lowest=lowest,
        misleading=len(misled) - 1,
        misled=false_of("misleading"),
        of_outputs=len({line["plant"] for line in outputs}),
        budget_outputs=calibrate_outputs.BUDGET,
        false_outputs=false_of_outputs(),
        outputs=table(["", *HEADER[1:4]], calibrate_outputs.rows()),
    )
    return text, {
        "calibration-noise": (HEADER, rows("reporting")),
        "calibration-noise-misleading": (("plant", *HEADER[1:]), misled),
    }


def false_of(half: str) -> str:
    """Return how many campaigns of a half were validated at 0.95 d_q*."""
    lines = [line for line in STORED.select(rule=RULE, share=0.95) if line["plant"] in HALVES[half]]
    return share_of(sum(line["answer"] == "validated" for line in lines), len(lines))


def validated_above(stored: Any, rule: int, plants: Sequence[str] | None = None) -> str:
    """Return how many campaigns were validated at 1.25 d*."""
    lines = [line for line in stored.select(rule=rule, share=1.25) if plants is None or line["plant"] in plants]
    return f"{sum(line['answer'] == 'validated' for line in lines)} of {len(lines)} at 1.25 d*"


def false_of_outputs() -> str:
    """Return how many campaigns with outputs were validated at 0.95 d*."""
    lines = calibrate_outputs.STORED.select(rule=calibrate_outputs.RULE, share=0.95)
    return share_of(sum(line["answer"] == "validated" for line in lines), len(lines))


def _by_kind(results: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return the answers by kind of imperfection, and those of all."""
    groups = {name: [line for line in results if line["imperfection"] in kinds] for name, kinds in _kinds().items()}
    return [row(name, of) for name, of in {**groups, "all": results}.items()]


def _coverage(results: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return how many bounds of each confidence hold, with noise and without it."""
    found = []
    for name, kinds in _kinds().items():
        bounds = [line["bounds"] for line in results if line["imperfection"] in kinds and line["bounds"] is not None]
        cells = []
        for confidence in CONFIDENCES:
            held = sum(each[str(confidence)] >= 1 - 1e-6 for each in bounds)
            low, high = interval(len(bounds) - held, len(bounds))
            cells.append(f"{held} of {len(bounds)} ({low:.0f} to {high:.0f} %)")
        found.append([name, *cells])
    return found


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


def _uniform(results: Sequence[dict[str, Any]]) -> tuple[str, str]:
    """Return the p-values of drawn tests, and how often chosen tasks are in the lowest tenth, in relation to chance."""
    tests, lowest = [], []
    for noise in NOISES:
        drawn, chosen = _ranks(results, noise)
        if len(drawn):
            probability = chisquare(np.histogram(drawn, BINS, (0, 1))[0]).pvalue
            tests.append(f"{noise} {probability:.2g} ({len(drawn)} executions)")
        if len(chosen):
            lowest.append(f"{noise} {(chosen < 1 / BINS).mean() * BINS:.1f}")
    return ", ".join(tests), ", ".join(lowest)


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
