"""``docs/calibration.md`` and its pictures, from the stored campaigns of ``calibrate.py``. Nothing is run here."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binom

import calibration_noise_part
import study_retrain
from calibrate import (
    CONFIDENCES,
    DRAWS,
    FAMILIES,
    NOISE,
    NOISY,
    NOISY_CHECKPOINTS,
    PATHS,
    ROOT,
    SYSTEMS,
    Run,
    stored,
)
from calibration_dynamics_part import by_dynamics
from calibration_outputs_part import from_outputs
from calibration_strangers_part import of_strangers
from calibration_verdicts_part import interval, table, until_decided
from ctxval.certificates import RESOLUTION
from ctxval.certificates.posterior import LEVEL

PAGE = ROOT / "docs" / "calibration.md"
PICTURES = ROOT / "docs" / "calibration"
THRESHOLDS = (0.5, 0.8, 0.9, 0.95, 0.99)
SIGNIFICANT = 0.01
STYLES = {1: ("#0072b2", "o", "-"), 2: ("#d55e00", "s", "--"), 4: ("#009e73", "^", ":")}


@dataclass(frozen=True)
class Cell:
    """The campaigns of one family and dimension at one size of their history.

    Attributes:
        family, dimension, n: which.
        results: pairs of the true maximum and what was certified.
    """

    family: str
    dimension: int
    n: int
    results: list[tuple[float, dict[str, Any]]]

    def search_shortfall(self, level: int) -> int:
        """Return how many bounds are below the truth, by more than rounding."""
        return sum(truth > check["bounds"][level] + 1e-9 * abs(truth) for truth, check in self.results)

    def tightness(self) -> tuple[float, float, float]:
        """Return quartiles of (bound - d*) / \\|d*\\| at 95 %."""
        gaps = [(check["bounds"][1] - truth) / abs(truth) for truth, check in self.results]
        low, middle, high = np.quantile(gaps, [0.25, 0.5, 0.75])
        return float(low), float(middle), float(high)

    def share(self, of: Callable[[float, dict[str, Any]], bool]) -> float:
        """Return the share of the campaigns of which something holds."""
        return float(np.mean([of(*result) for result in self.results]))

    def falsely_validated(self, relative: float, level: int = 1) -> tuple[int, int]:
        """Return how many campaigns say validated for a threshold of so much of d*, and of how many."""
        positive = [(truth, check) for truth, check in self.results if truth > 0]
        wrong = sum(not is_doubted(check) and check["bounds"][level] <= relative * truth for truth, check in positive)
        return wrong, len(positive)


def is_doubted(check: dict[str, Any]) -> bool:
    """Return whether the diagnosis withdraws a bound."""
    return bool(check["surprise"] < LEVEL or check["farthest"] > RESOLUTION)


def cells(names: Iterable[tuple[str, int]], key: str = "checks") -> list[Cell]:
    """Return the stored campaigns, family by family and checkpoint by checkpoint."""
    found = []
    for family, dimension in names:
        results = [result for result in stored(family, dimension) if result[key]]
        for at, n in enumerate(Run(family, dimension, 0).checkpoints):
            pairs = [(r["truth"], r[key][at]) for r in results if "bounds" in r[key][at]]
            if pairs:
                found.append(Cell(family, dimension, n, pairs))
    return found


def coverage(missed: int, total: int, confidence: float) -> str:
    """Return a coverage with what was missed; bold where it is below what is stated by more than chance."""
    text = f"{100 * (1 - missed / total):.1f} % ({missed}/{total})"
    chance = float(binom.sf(missed - 1, total, 1 - confidence))
    return f"**{text}**" if chance < SIGNIFICANT else text


def exact_table() -> str:
    """Return the coverage on draws of the prior, with the posterior exactly as Bayes has it."""
    rows = []
    for cell in cells([("prior", d) for d in FAMILIES["prior"][1]], "exact"):
        levels = []
        for level, confidence in enumerate(CONFIDENCES):
            missed = cell.search_shortfall(level)
            low, high = interval(missed, len(cell.results))
            levels.append(f"{coverage(missed, len(cell.results), confidence)}, {low:.1f} to {high:.1f} %")
        rows.append([f"{cell.dimension}-D", str(cell.n), *levels])
    return table(["", "executions", *(f"stated {100 * c:g} %" for c in CONFIDENCES)], rows)


def used_table(names: Iterable[tuple[str, int]]) -> str:
    """Return coverage and tightness as the bound is used."""
    rows = []
    for cell in cells(names):
        low, middle, high = cell.tightness()
        plugged = cell.share(
            lambda truth, check: check["max_ucb"] is not None and check["max_ucb"] >= truth * (1 - 1e-9)
        )
        rows.append(
            [
                cell.family,
                f"{cell.dimension}-D",
                str(cell.n),
                *(coverage(cell.search_shortfall(k), len(cell.results), c) for k, c in enumerate(CONFIDENCES)),
                f"{100 * cell.share(lambda _, check: is_doubted(check)):.0f} %",
                f"{100 * plugged:.0f} %",
                f"{100 * middle:.2g} % ({100 * low:.2g} to {100 * high:.2g})",
            ]
        )
    stated = [f"stated {100 * c:g} %" for c in CONFIDENCES]
    return table(
        ["function", "", "executions", *stated, "withdrawn", "max UCB covers", "(bound - d*) / d* at 95 %"], rows
    )


def validation_table(names: Iterable[tuple[str, int]]) -> str:
    """Return how often a campaign said validated against a threshold below d*."""
    rows = []
    for cell in cells(names):
        counts = [cell.falsely_validated(relative) for relative in THRESHOLDS]
        if counts[0][1]:
            rates = [f"{100 * wrong / total:.1f} % ({wrong})" for wrong, total in counts]
            rows.append([cell.family, f"{cell.dimension}-D", str(cell.n), str(counts[0][1]), *rates])
    header = ["function", "", "executions", "campaigns", *(f"tau = {t:g} d*" for t in THRESHOLDS)]
    return table(header, rows)


def retrained() -> str:
    """Return how often the audit of a model that was learned again is false."""
    rows = []
    for study in study_retrain.STORED.values():
        low, high = interval(study["campaigns"] - study["false"], study["campaigns"])
        share = 100 * study["false"] / study["campaigns"]
        counted = f"{study['false']} of {study['campaigns']} ({share:.1f} %, {low:.1f} to {high:.1f} %)"
        rows.append([study["second_audit"], counted])
    sentence = (
        f"A model is audited by {study['draws']} draws. It is then learned again, so that it is exact near all of "
        f"these draws and as wrong as before elsewhere. It is audited again with the same seed. The distance exceeds "
        f"the threshold on {300 * study['volume']:.3g} % of the tasks. The audit may leave out "
        f"{100 * study['volume']:.3g} %, with confidence {study['confidence']}."
    )
    wrapped = "\n".join(textwrap.wrap(sentence, 120))
    return f"{wrapped}\n\n{table(['second audit', 'falsely validated'], rows)}"


# Pictures


def save(figure: Figure, name: str) -> None:
    """Write a picture."""
    figure.savefig(PICTURES / name, dpi=150)


def draw_coverage() -> None:
    """Draw the coverage of the 95 % bound, each family and dimension at the last checkpoint but one."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    names = list(FAMILIES)
    for offset, (dimension, (colour, marker, _)) in zip((-0.2, 0.0, 0.2), STYLES.items(), strict=True):
        for at, family in enumerate(names):
            found = cells([(family, dimension)] if dimension in FAMILIES[family][1] else [])
            for shade, cell in zip((0.45, 0.7, 1.0), found, strict=False):
                missed, total = cell.search_shortfall(1), len(cell.results)
                x = at + offset + 0.06 * (shade - 0.7) / 0.3
                axes.plot([x, x], interval(missed, total), color=colour, alpha=shade, linewidth=1)
                axes.plot(x, 100 * (1 - missed / total), marker, color=colour, alpha=shade, markersize=5)
    for dimension, (colour, marker, _) in STYLES.items():
        axes.plot([], [], marker, color=colour, label=f"{dimension}-D")
    axes.axhline(95, color="#000000", linewidth=1, linestyle=(0, (6, 4)), label="stated")
    axes.set_xticks(range(len(names)), names, rotation=20)
    axes.set_ylabel("campaigns whose bound holds [%]")
    axes.set_ylim(40, 101)
    axes.grid(axis="y", alpha=0.25)
    figure.legend(loc="outside upper center", ncols=4, fontsize=8)
    save(figure, "coverage.png")


def draw_tightness() -> None:
    """Draw the median gap between the 95 % bound and d* against the executions."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    dimensions = [d for d in STYLES if cells([(family, d) for family, (_, ds) in FAMILIES.items() if d in ds])]
    panels = figure.subplots(1, len(dimensions), sharey=True, squeeze=False)[0]
    colours = ["#000000", "#e69f00", "#56b4e9", "#009e73", "#0072b2", "#d55e00", "#cc79a7"]
    lines = ["-", "--", ":", "-.", (0, (1, 1)), (0, (5, 1)), (0, (3, 1, 1, 1))]
    for axes, dimension in zip(panels, dimensions, strict=True):
        for family, colour, line in zip(FAMILIES, colours, lines, strict=True):
            found = cells([(family, dimension)] if dimension in FAMILIES[family][1] else [])
            if found:
                gaps = [max(100 * cell.tightness()[1], 0.01) for cell in found]
                label = family if dimension == 2 else None
                axes.plot([cell.n for cell in found], gaps, color=colour, linestyle=line, marker=".", label=label)
        axes.set_title(f"{dimension}-D", fontsize=9)
        axes.set_yscale("log")
        axes.set_xlabel("executions")
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("(bound - d*) / d* at 95 %, median [%]")
    figure.legend(loc="outside upper center", ncols=4, fontsize=8)
    save(figure, "tightness.png")


TEXT = """# Coverage of the bounds

Generated by `make calibrate` from the stored campaigns in `benchmarks/results/`; nothing here is written by hand.

This page measures how often the posterior bounds hold, and how often a verdict is false. The data are {total:,}
campaigns of GP-UCB with seeds from 0 on. Each campaign is certified at two or three sizes of its history. This gives
{bounds:,} posterior bounds at each of three confidences. Each bound uses {draws} draws of hyperparameters with {paths}
paths each.

In the tables, the numbers in parentheses are the number of bounds that were too low, and the number of all bounds. A
bold entry means that significantly fewer bounds hold than stated (binomial test at 1 %).

## Functions from the prior, with the exact Bayesian posterior

Here the measured coverage must agree with the stated confidence: the 95 % interval of the measured coverage must
contain it.

{exact}

## Bounds as used in practice

Real distances are not draws from the prior. The bound that is used in practice is therefore no smoother than the
best-spread trials suggest (`spread_share` in `gp/hyperposterior.py`). It is too wide on draws from the prior, and it is
meant to hold on other functions.

- `withdrawn`: the diagnosis withdrew the bound, because a trial was surprising or because a task was farther than
  {resolution:g} diagonals from all trials. Corners without a trial also withdraw a bound, but they are not counted
  here. The coverage is that of all bounds, withdrawn or not.
- `max UCB covers`: how often `max (mu + sqrt(2) sigma)` is above d*. This is the paper's Gaussian process with
  estimated hyperparameters.

{used}

![Coverage](calibration/coverage.png)

Each point is one family, dimension and number of executions, with its 95 % interval. Darker points have more
executions.

![Tightness](calibration/tightness.png)

## The paper's systems

These are the campaigns that `ctxval reproduce` stored, with ten seeds each. Ten seeds cannot distinguish 95 % from
85 %.

{systems}

## Noisy systems

The values have normal noise with a standard deviation of {noise:g} standard deviations of the expected values. The
tasks are random. The bound is one on the largest expected value, and it is compared
with that value.

{noisy}

{until_decided}

{by_dynamics}

{of_strangers}

{under_noise}
{from_outputs}

## Audits after retraining

{retrained}

## False validations of campaigns with a fixed number of executions

These campaigns do not execute the tasks that are far from all trials. They are certified after a fixed number of
executions. The table counts the campaigns that are `validated` with confidence 95 % against a threshold below the true
maximum, with the diagnosis switched on. The target is at most 5 %. A threshold far below d* is hardly ever validated; a
threshold just below d* is the hardest case.

{validation}

{system_validation}
"""


def main() -> None:
    """Write the page."""
    matplotlib.use("Agg")
    names = [(family, d) for family, (_, dimensions) in FAMILIES.items() for d in dimensions]
    systems = [(name, system.dimension) for name, system in SYSTEMS.items()]
    noisy = [(name, d) for name in NOISY for d in NOISY_CHECKPOINTS]
    all_cells = cells([*names, *systems, *noisy])
    draw_coverage()
    draw_tightness()
    calibration_noise_part.draw()
    PAGE.write_text(
        TEXT.format(
            total=sum(len(stored(*name)) for name in [*names, *systems, *noisy]),
            bounds=sum(len(cell.results) for cell in all_cells),
            draws=DRAWS,
            paths=PATHS,
            resolution=RESOLUTION,
            exact=exact_table(),
            used=used_table(names),
            systems=used_table(systems),
            validation=validation_table(names),
            system_validation=validation_table(systems),
            noise=NOISE,
            noisy=used_table(noisy),
            until_decided=until_decided(),
            by_dynamics=by_dynamics(),
            of_strangers=of_strangers(),
            under_noise=calibration_noise_part.under_noise(),
            from_outputs=from_outputs(),
            retrained=retrained(),
        )
    )
    print(f"page: {Path(PAGE).relative_to(ROOT)}")


if __name__ == "__main__":
    main()
