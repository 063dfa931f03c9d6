"""A study of one figure, with its jobs, picture, data and claims, and the figures that several studies share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from ctxval._util.arrays import Array, Mask
from reproduce.frameworks import PAPER
from reproduce.jobs import Job, Results, distances_of

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
    """The scale of a reproduction: its name, the trials of each median, and its share of the full grids and budgets."""

    name: str
    trials: int
    share: float

    @property
    def seeds(self) -> range:
        return range(self.trials)

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
    """One claim of the paper, with the measured numbers, and whether they agree with it."""

    paper: str
    measured: str
    agrees: Agreement
    remark: str = ""  #: the reason for a difference, if known; it is shown only if the numbers do not agree


Columns = dict[str, Sequence[float | str]]  #: the data behind a figure, as columns of equal length


class Study(ABC):
    """One figure of the paper."""

    name: str  #: its name on the command line, and the name of its files
    title: str
    case: str  #: the case that it runs on
    axes: tuple[str, str] = ("executions of S", "")  #: the labels of the two axes
    legend = 2  #: the number of columns of the legend

    @abstractmethod
    def jobs(self, scale: Scale) -> list[Job]:
        """Return the jobs whose results the study needs."""

    def fill(self, axes: Axes, results: Results, scale: Scale) -> None:  # noqa: B027, if draw is another one
        """Draw the results into the axes of the figure."""

    @abstractmethod
    def data(self, results: Results, scale: Scale) -> Columns:
        """Return the numbers that the figure shows."""

    @abstractmethod
    def claims(self, results: Results, scale: Scale) -> Iterable[Claim]:
        """Return the paper's claims about the figure, with the measured numbers."""

    def draw(self, results: Results, scale: Scale) -> Figure:
        from matplotlib.figure import Figure  # imported here, because only figures need it

        figure = Figure(figsize=(6.4, 4.2), layout="constrained")
        axes = figure.add_subplot(xlabel=self.axes[0], ylabel=self.axes[1])
        axes.grid(alpha=0.25)
        self.fill(axes, results, scale)
        figure.legend(loc="outside upper center", ncols=self.legend, fontsize=8)
        return figure


class Place(NamedTuple):
    """A place on the horizontal axis: its value, the options of the case, and how near to d* the estimate must be."""

    x: float
    options: tuple[tuple[str, Any], ...]
    percent: float


class ExecutionsWithin(Study):
    """Executions until the estimate is within some per cent of d*, for each technique and place."""

    column: str  #: the name of the places in the data
    places: tuple[Place, ...]
    dodge: float  #: the horizontal distance between the triangles of two techniques

    @abstractmethod
    def budget(self, search: str, scale: Scale) -> int:
        """Return the number of executions of a technique."""

    def jobs(self, scale: Scale) -> list[Job]:
        different = dict.fromkeys(place.options for place in self.places)
        runs = [(options, seed) for options in different for seed in scale.seeds]
        searches = [self._job(search, *run, scale) for search in ("gp-ucb", "random") for run in runs]
        return searches + [Job("truth", self.case, seed, options) for options, seed in runs]

    def _job(self, search: str, options: tuple[tuple[str, Any], ...], seed: int, scale: Scale) -> Job:
        ran = "gp-ucb" if search == "gp-ucb" else "random"  # SD uses the same samples as SC, so one run serves both
        return Job("search", self.case, seed, options, ran, self.budget(search, scale))

    def executions(self, results: Results, scale: Scale, search: str) -> Array:
        """Return the numbers of executions, shape ``(places, trials)``; infinity if the estimate never gets there."""
        counts = np.empty((len(self.places), scale.trials))
        for i, seed in np.ndindex(counts.shape):
            options = self.places[i].options
            truth = results[Job("truth", self.case, seed, options)]["distance"]
            distances = distances_of(results[self._job(search, options, seed, scale)])
            counts[i, seed] = executions_within(distances, search, truth, self.places[i].percent)
        return counts

    def fill(self, axes: Axes, results: Results, scale: Scale) -> None:
        """Draw the medians; an open triangle at the budget means that the median never gets there."""
        x = np.array([place.x for place in self.places])
        for i, (search, (label, colour, line, marker)) in enumerate(TECHNIQUES.items()):
            medians = np.array([spread(row)[0] for row in self.executions(results, scale, search)])
            never = np.isinf(medians)
            axes.semilogy(x[~never], medians[~never], color=colour, linestyle=line, marker=marker, label=label)
            at = np.full(int(never.sum()), self.budget(search, scale))
            axes.semilogy(x[never] + (i - 1) * self.dodge, at, "^", color=colour, markersize=8, fillstyle="none")
        axes.plot([], [], "^", color=BLACK, fillstyle="none", label="not within the budget")

    def data(self, results: Results, scale: Scale) -> Columns:
        columns: Columns = {self.column: [place.x for place in self.places]}
        for search in TECHNIQUES:
            spreads = np.array([spread(row) for row in self.executions(results, scale, search)])
            names = (f"{search}_{part}" for part in ("median", "min", "max"))
            columns |= zip(names, spreads.T.tolist(), strict=True)
        return columns


def draw_quartiles(axes: Axes, rows: dict[str, Array]) -> None:
    """Draw the median and the quartiles of each technique over the executions, from rows ``(trials, budget)``."""
    for search, (label, colour, line, marker) in TECHNIQUES.items():
        low, median, high = np.percentile(rows[search], [25, 50, 75], axis=0)
        counts = np.arange(1, len(median) + 1)
        every = max(1, len(median) // 10)
        axes.fill_between(counts, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(counts, median, color=colour, linestyle=line, marker=marker, markevery=every, label=label)


def running_estimate(distances: Sequence[float] | Array, search: str) -> Array:
    """Return the largest distance, or the largest that SD keeps, after 1, 2, ... executions; NaN until there is one."""
    discard, largest = PAPER.discarded if search == "sampling-discarding" else 0, list[float]()
    estimates = np.full(len(distances), np.nan)
    for k, distance in enumerate(distances):
        if not np.isnan(distance):
            largest = sorted([*largest, distance], reverse=True)[: discard + 1]
        if len(largest) > discard:
            estimates[k] = largest[discard]
    return estimates


def executions_within(distances: Sequence[float] | Array, search: str, truth: float, percent: float) -> float:
    """Return the number of executions until the estimate is within ``percent`` per cent of d*; infinity if never."""
    return first(running_estimate(distances, search) >= truth * (1 - percent / 100))


def first(reached: Mask) -> float:
    """Return the number of the first execution at which something is reached; infinity for never."""
    return float(np.argmax(reached) + 1) if reached.any() else np.inf


def spread(values: Sequence[float] | Array) -> tuple[float, float, float]:
    """Return median, smallest and largest value, where infinity stands for never: its mean with a number is never."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.median(array)), float(array.min()), float(array.max())


def ranged(values: Sequence[float] | Array, digits: int) -> str:
    """Return the median of values with their range, as text with so many decimals."""
    median, low, high = (f"{value:.{digits}f}" for value in spread(values))
    return f"{median} (from {low} to {high})"


def counted(value: float, budget: int) -> str:
    """Return a number of executions as text; ``> budget`` for never."""
    return f"> {budget:,}" if np.isinf(value) else f"{value:,.4g}"
