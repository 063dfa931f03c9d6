"""``docs/calibration.md``, its tables and pictures, from stored campaigns. Nothing is run here."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binom

import calibrate_noise
import calibrate_outputs
import calibration_dynamics_part
import calibration_noise_part
import calibration_strangers_part
import calibration_verdicts_part
import study_retrain
import study_time_varying
from calibrate import CONFIDENCES, DRAWS, FAMILIES, NOISE, NOISY, NOISY_CHECKPOINTS, PATHS, SYSTEMS, Run, stored
from ctxval.certificates import RESOLUTION
from ctxval.certificates.posterior import LEVEL
from page_tables import DOCS, GeneratedPage, Table, interval, reflowed, share_of, table

PICTURES = DOCS / "calibration"
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

    def missed(self, level: int) -> int:
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


Names = list[tuple[str, int]]
FUNCTIONS: Names = [(family, d) for family, (_, dimensions) in FAMILIES.items() for d in dimensions]
PAPER: Names = [(name, system.dimension) for name, system in SYSTEMS.items()]
NOISY_FUNCTIONS: Names = [(name, d) for name in NOISY for d in NOISY_CHECKPOINTS]
STATED = [f"stated {100 * c:g} %" for c in CONFIDENCES]


def exact_table() -> Table:
    """Return the coverage on draws of the prior, with the posterior exactly as Bayes has it."""
    rows = []
    for cell in cells([("prior", d) for d in FAMILIES["prior"][1]], "exact"):
        levels = []
        for level, confidence in enumerate(CONFIDENCES):
            missed = cell.missed(level)
            low, high = interval(missed, len(cell.results))
            levels.append(f"{coverage(missed, len(cell.results), confidence)}, {low:.1f} to {high:.1f} %")
        rows.append([f"{cell.dimension}-D", str(cell.n), *levels])
    return ["dimension", "executions", *STATED], rows


def used_table(names: Names) -> Table:
    """Return coverage and tightness as the bound is used."""
    rows = []
    for cell in cells(names):
        low, middle, high = cell.tightness()
        rows.append(
            [
                *(cell.family, f"{cell.dimension}-D", str(cell.n)),
                *(coverage(cell.missed(k), len(cell.results), c) for k, c in enumerate(CONFIDENCES)),
                f"{100 * cell.share(lambda _, check: is_doubted(check)):.0f} %",
                f"{100 * cell.share(_plugged):.0f} %",
                f"{100 * middle:.2g} % ({100 * low:.2g} to {100 * high:.2g})",
            ]
        )
    header = [
        "function",
        "dimension",
        "executions",
        *STATED,
        "withdrawn",
        "max UCB covers",
        "(bound - d*) / d* at 95 %",
    ]
    return header, rows


def _plugged(truth: float, check: dict[str, Any]) -> bool:
    """Return whether the paper's largest upper confidence bound covers the truth."""
    return bool(check["max_ucb"] is not None and check["max_ucb"] >= truth * (1 - 1e-9))


def _range(shares: Iterable[float]) -> str:
    found = sorted(shares)
    return f"{found[0]:.0f} to {found[-1]:.0f} %"


def lowest_table() -> str:
    """Return the lowest coverage of the 95 % bound of each family and dimension, over the sizes of the history."""
    rows = []
    for family in FAMILIES:
        found = cells((family, d) for f, d in FUNCTIONS if f == family)
        row = [family]
        for d in (1, 2):
            of = [cell for cell in found if cell.dimension == d]
            worst = max(of, key=lambda cell: cell.missed(1) / len(cell.results), default=None)
            row.append("-" if worst is None else f"{coverage(worst.missed(1), len(worst.results), 0.95)} at {worst.n}")
        rows.append(row)
    return table(["function", "1-D", "2-D"], rows)


def validation_table(names: Names) -> Table:
    """Return how often a campaign said validated against a threshold below d*."""
    rows = []
    for cell in cells(names):
        counts = [cell.falsely_validated(relative) for relative in THRESHOLDS]
        if counts[0][1]:
            rates = [f"{100 * wrong / total:.1f} % ({wrong})" for wrong, total in counts]
            rows.append([cell.family, f"{cell.dimension}-D", str(cell.n), str(counts[0][1]), *rates])
    return ["function", "dimension", "executions", "campaigns", *(f"tau = {t:g} d*" for t in THRESHOLDS)], rows


def falsest() -> str:
    """Return the largest shares of false validations after a fixed number of executions."""
    shares = []
    for cell in cells([*FUNCTIONS, *PAPER]):
        wrong, total = cell.falsely_validated(0.99)
        if total:
            shares.append(
                (wrong / total, f"{cell.family}, {cell.dimension}-D, {cell.n} executions: {wrong} of {total}")
            )
    return "; ".join(text for _, text in sorted(shares, reverse=True)[:3])


def summary() -> str:
    """Return how many verdicts were false and true, by the sets of campaigns on this page."""
    strangers = calibration_strangers_part.reported()
    regular = calibration_strangers_part.regular_above(strangers)
    timed = study_time_varying.STORED.select(share=0.95)
    rows = [
        [
            "systems of strangers",
            calibration_strangers_part.false_of(strangers),
            f"{sum(line['answer'] == 'validated' for line in regular)} of {len(regular)} at 1.25 d*",
        ],
        [
            "noise, encoders, late commands",
            calibration_noise_part.false_of("reporting"),
            calibration_noise_part.validated_above(
                calibrate_noise.STORED, calibrate_noise.RULE, list(calibrate_noise.HALVES["reporting"])
            ),
        ],
        [
            "outputs in place of states",
            calibration_noise_part.false_of_outputs(),
            calibration_noise_part.validated_above(calibrate_outputs.STORED, calibrate_outputs.RULE),
        ],
        ["reporting systems, learned dynamics", *calibration_dynamics_part.summary("reporting")],
        ["the paper's cases, learned dynamics", *calibration_dynamics_part.summary("paper")],
        ["models rougher than the system", *calibration_dynamics_part.summary("rough")],
        [
            "dynamics that change with time",
            share_of(sum(line["answer"] == "validated" for line in timed), len(timed)),
            "-",
        ],
        [
            "scalar functions, posterior bound",
            calibration_verdicts_part.false_of(calibration_verdicts_part.reported_false()),
            "-",
        ],
        ["different dynamics in some tasks (chosen to be hard)", calibration_strangers_part.false_of_drawn(), "-"],
        ["carts that break an assumption", calibration_noise_part.false_of("misleading"), "-"],
    ]
    return table(["campaigns", "0.95 d*: validated, which is false", "validated above d*"], rows)


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
                missed, total = cell.missed(1), len(cell.results)
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

Generated by `make calibrate` from the stored campaigns in `benchmarks/results/`.

How often do bounds hold, and how often is a verdict false? Campaigns run on systems whose true largest distance d*
is known from a long search. A threshold below d* makes `validated` false; the target is at most 5 % at 0.95 d*. A
threshold above d* measures how often a campaign reaches a true validation. Shares have their upper limit with
confidence 97.5 % (Clopper and Pearson).

{summary}

Most false verdicts are on systems whose dynamics differ in few tasks, or in a small place, that no execution has
met. No number of executions excludes this. The verdict therefore states the share of the tasks that its tests alone
support.

{strangers}

{noise}

{dynamics}

## The posterior bound of the distance

The data are {total:,} campaigns of GP-UCB, certified at two or three sizes of their histories: {bounds:,} bounds at
each of three confidences, each from {draws} draws of hyperparameters with {paths} paths.

**On functions from the prior, with the exact Bayesian posterior**, the measured coverage must agree with the stated
confidence: its 95 % interval lies below the stated one in {too_low} of {exact_cases} cases and above it in
{too_high} ([table](tables/calibration-exact.csv)).

**As used in practice**, the bound is no smoother than the best-spread trials suggest (`spread_share` in
`gp/hyperposterior.py`), because real distances are no draws from the prior. The table has the lowest coverage at
95 % over the numbers of executions, before the diagnosis withdraws bounds; (k/n) are k bounds of n that are too low,
and bold entries are significantly below 95 % (binomial test at 1 %).

{lowest}

Nearly all of these bounds are withdrawn in 2-D, and hardly any after 20 executions in 1-D, because some task is
farther than {resolution:g} diagonals from all trials. On the paper's systems (ten seeds), coverage is lowest on
{worst} executions); all of these bounds are withdrawn. The paper's largest upper confidence bound, with estimated
hyperparameters, covers d* in {plugged} of the cases. With normal noise of {noise_share:g} standard deviations,
{noisy} of the bounds of the largest expected value hold at 95 %.

![Coverage](calibration/coverage.png)

Each point is one family, dimension and number of executions, with its 95 % interval. Darker points have more
executions.

![Tightness](calibration/tightness.png)

Tables: [functions](tables/calibration-bounds.csv), [the paper's systems](tables/calibration-bounds-paper.csv),
[noisy systems](tables/calibration-bounds-noisy.csv).

{verdicts}

**After a fixed number of executions**, without covering the task space, a campaign is falsely validated at 0.99 d*
at most in these shares: {falsest}. The target is 5 % ([functions](tables/calibration-fixed.csv), [the paper's
systems](tables/calibration-fixed-paper.csv)).

## Audits after retraining

A model is audited by {retrained_draws} draws and learned again, so that it is exact near all of them and as wrong as
before elsewhere. A second audit with the same draws is false in {same}; one whose draws depend on the model, as
`ctxval` draws them, in {new}. The audit may leave out {volume:g} % of the tasks with confidence {confidence}, and
{exceeding:.3g} % exceed the threshold.
"""


def page() -> GeneratedPage:
    """Return the page and its tables."""
    strangers, strangers_tables = calibration_strangers_part.of_strangers()
    noise, noise_tables = calibration_noise_part.under_noise()
    dynamics, dynamics_tables = calibration_dynamics_part.by_dynamics()
    verdicts, verdicts_tables = calibration_verdicts_part.until_decided()
    exact = cells([("prior", d) for d in FAMILIES["prior"][1]], "exact")
    intervals = [
        (*interval(cell.missed(level), len(cell.results)), 100 * confidence)
        for cell in exact
        for level, confidence in enumerate(CONFIDENCES)
    ]
    paper, noisy = cells(PAPER), cells(NOISY_FUNCTIONS)
    worst = max(paper, key=lambda cell: cell.missed(1) / len(cell.results))
    retrained = {study["second_audit"]: study for study in study_retrain.STORED.values()}
    same, new = retrained["the same draws"], retrained["draws that depend on the model"]
    everything = [*FUNCTIONS, *PAPER, *NOISY_FUNCTIONS]
    text = TEXT.format(
        summary=summary(),
        strangers=strangers,
        noise=noise,
        dynamics=dynamics,
        verdicts=verdicts,
        total=sum(len(stored(*name)) for name in everything),
        bounds=sum(len(cell.results) for cell in cells(everything)),
        draws=DRAWS,
        paths=PATHS,
        too_low=sum(high < stated for _, high, stated in intervals),
        too_high=sum(low > stated for low, _, stated in intervals),
        exact_cases=len(intervals),
        worst=f"{worst.family} ({worst.missed(1)} of {len(worst.results)} too low, after {worst.n}",
        plugged=_range(100 * cell.share(_plugged) for cell in paper),
        noisy=_range(100 * (1 - cell.missed(1) / len(cell.results)) for cell in noisy),
        lowest=lowest_table(),
        resolution=RESOLUTION,
        noise_share=NOISE,
        falsest=falsest(),
        retrained_draws=same["draws"],
        same=f"{same['false']} of {same['campaigns']}",
        new=f"{new['false']} of {new['campaigns']}",
        volume=100 * same["volume"],
        confidence=same["confidence"],
        exceeding=300 * same["volume"],
    )
    tables = {
        "calibration-exact": exact_table(),
        "calibration-bounds": used_table(FUNCTIONS),
        "calibration-bounds-paper": used_table(PAPER),
        "calibration-bounds-noisy": used_table(NOISY_FUNCTIONS),
        "calibration-fixed": validation_table(FUNCTIONS),
        "calibration-fixed-paper": validation_table(PAPER),
    }
    return GeneratedPage(
        "calibration.md",
        reflowed(text),
        {**tables, **strangers_tables, **noise_tables, **dynamics_tables, **verdicts_tables},
    )


def main() -> None:
    """Write the page, its tables and pictures."""
    matplotlib.use("Agg")
    draw_coverage()
    draw_tightness()
    calibration_noise_part.draw()
    page().write()


if __name__ == "__main__":
    main()
