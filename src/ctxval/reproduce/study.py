"""The contract of a study of one figure, with its jobs, picture, data and claims, and helpers for all studies."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from ctxval._util.arrays import Array
from ctxval.reproduce.jobs import DISCARDED, Job, Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, PINK, BLACK, GREY = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#000000", "#999999"
"""Colours of Okabe and Ito; line styles and markers differ too, so that the figures are readable in grey."""

TECHNIQUES = {
    "gp-ucb": ("CuSTOM (GP-UCB)", BLUE, "-", "o"),
    "random": ("scenario (SC)", ORANGE, "--", "s"),
    "sampling-discarding": ("sampling and discarding (SD, k = 5)", GREEN, ":", "^"),
}
"""The paper's three techniques: label, colour, line, marker."""


@dataclass(frozen=True)
class Scale:
    """The scale of a reproduction.

    Attributes:
        name: the name, full or quick.
        trials: number of trials of each median.
        share: fraction of the full grids and budgets.
    """

    name: str
    trials: int
    share: float

    def of(self, full: int) -> int:
        """Return this scale's share of a grid or a budget."""
        return max(2, round(self.share * full))


FULL, QUICK = Scale("full", 10, 1.0), Scale("quick", 3, 0.3)


Agreement = Literal["yes", "partly", "no"]


def agreement(whole: bool, part: bool = False) -> Agreement:
    """Return whether numbers agree with a claim: wholly, at least with a part of it, or not."""
    return "yes" if whole else "partly" if part else "no"


@dataclass(frozen=True)
class Claim:
    """One claim of the paper, with the measured numbers.

    Attributes:
        paper: the claim of the paper.
        measured: the measured numbers.
        agrees: whether they agree with the claim: yes, partly or no.
        remark: the reason for a difference, if known; it is shown only if the numbers do not agree.
    """

    paper: str
    measured: str
    agrees: Agreement
    remark: str = ""


@dataclass(frozen=True)
class Columns:
    """The data behind a figure, as columns of equal length."""

    names: Sequence[str]
    values: Sequence[Sequence[float | str]] = field(default_factory=list)

    def write(self, path: Path) -> None:
        """Write the columns as CSV."""
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(self.names)
            writer.writerows(zip(*self.values, strict=True))


class Study(Protocol):
    """One figure of the paper."""

    name: str
    title: str
    case: str

    def jobs(self, scale: Scale) -> list[Job]:
        """Return the jobs whose results the study needs."""

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return the figure."""

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return the numbers that the figure shows."""

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claims about the figure, with the measured numbers."""


def new_figure(width: float = 6.4, height: float = 4.2) -> Figure:
    """Return an empty figure."""
    from matplotlib.figure import Figure  # imported here, because only figures need it

    return Figure(figsize=(width, height), layout="constrained")


def running_estimate(distances: Sequence[float] | Array, search: str) -> Array:
    """Return the estimates of d* after 1, 2, ... executions: the largest distance, or the largest one that SD keeps.

    The estimate is NaN until there is one. Failed executions count as executions and do not change the estimate.
    """
    discard = DISCARDED if search == "sampling-discarding" else 0
    largest: list[float] = []
    estimates = np.full(len(distances), np.nan)
    for k, distance in enumerate(distances):
        if not np.isnan(distance):
            largest = sorted([*largest, distance], reverse=True)[: discard + 1]
        if len(largest) > discard:
            estimates[k] = largest[discard]
    return estimates


def executions_within(distances: Sequence[float] | Array, search: str, truth: float, percent: float) -> float:
    """Return the number of executions until the estimate is within ``percent`` per cent of d*; infinity if never."""
    reached = running_estimate(distances, search) >= truth * (1 - percent / 100)
    return float(np.argmax(reached) + 1) if reached.any() else np.inf


def spread(values: Sequence[float] | Array) -> tuple[float, float, float]:
    """Return median, smallest and largest value, where infinity stands for never: its mean with a number is never."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.median(array)), float(array.min()), float(array.max())


def ranged(values: Sequence[float] | Array, digits: int) -> str:
    """Return the median of values with their range, as text with so many decimals."""
    median, low, high = (f"{value:.{digits}f}" for value in spread(values))
    return f"{median} (from {low} to {high})"


def draw_executions(axes: Axes, x: Array, medians: dict[str, Array], budgets: dict[str, int], dodge: float) -> None:
    """Draw the median executions of each technique; an open triangle at the budget stands for never.

    ``dodge`` is the horizontal distance between the triangles of two techniques.
    """
    for i, (search, (label, colour, line, marker)) in enumerate(TECHNIQUES.items()):
        never = np.isinf(medians[search])
        known = medians[search][~never]
        axes.semilogy(x[~never], known, color=colour, linestyle=line, marker=marker, label=label)
        at = np.full(int(never.sum()), budgets[search])
        axes.semilogy(x[never] + (i - 1) * dodge, at, "^", color=colour, markersize=8, fillstyle="none")
    axes.plot([], [], "^", color=BLACK, fillstyle="none", label="not within the budget")
    axes.grid(alpha=0.25)


def counted(value: float, budget: int) -> str:
    """Return a number of executions as text; ``> budget`` for never."""
    return f"> {budget:,}" if np.isinf(value) else f"{value:,.4g}"
