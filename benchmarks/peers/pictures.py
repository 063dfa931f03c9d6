"""The pictures of ``docs/benchmarks.md``, from the stored results. Nothing is run here."""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from peers.functions import CASES
from peers.methods import METHODS
from peers.overhead import COUNTS
from peers.page import PICTURES, Cell, cells, seconds

CLOSEST = 1.0
"""Per cent of d*; runs end there, so less is drawn as this."""


@dataclass(frozen=True)
class Style:
    """How a method is drawn: by colour, and by marker and line where there is no colour."""

    colour: str
    marker: str
    line: Any


# Okabe and Ito's colours; lines and markers tell apart what is printed in grey.
COLOURS = ["#000000", "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"]
MARKERS = ["o", "s", "^", "v", "P", "X", "<", ">", "*"]
LINES: list[Any] = ["-", "--", ":", "-.", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 3))]
PANELS: dict[str, tuple[str, ...]] = {
    "ours": ("scalar", "auto", "auto-no-data", "vector", "gp-ucb"),
    "others, with a model of the distance": (
        *("scalar", "gpyopt", "botorch-log-ei", "botorch-ucb", "turbo", "optuna-gp"),
        *("verifai-bo", "egobox", "bayesian-optimization"),
    ),
    "others, without": (
        *("scalar", "cma-es", "dual-annealing", "direct", "verifai-ce", "verifai-mab", "verifai-halton"),
        *("psy-taliro-annealing", "psy-taliro-uniform", "random"),
    ),
}
"""Our scalar search is in each, to compare with."""


def style(name: str) -> Style:
    """Return how a method is drawn, in all pictures alike."""
    if name == "scalar":
        return Style("#000000", "D", "-")
    panel = next(names for names in PANELS.values() if name in names)
    at = [other for other in panel if other != "scalar"].index(name)
    # Colours repeat after six; the line then is another one.
    return Style(COLOURS[1 + at % 6], MARKERS[at], LINES[1 + (at + at // 6) % 6])


def save(figure: Figure, name: str) -> None:
    """Write a picture beside the page."""
    PICTURES.mkdir(exist_ok=True)
    figure.savefig(PICTURES / name, dpi=130)


def draw_regrets(case: str) -> None:
    """Draw the median regret of each method against executions."""
    found = {cell.method: cell for cell in cells(case)}
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    panels = figure.subplots(1, len(PANELS), sharey=True)
    for axes, (title, names) in zip(panels, PANELS.items(), strict=True):
        for at, name in enumerate(names):
            if name in found:
                draw_regret(axes, found[name], at)
        axes.set_title(title, fontsize=10)
        axes.set_yscale("log")
        axes.set_ylim(0.9 * CLOSEST, 105)
        axes.set_yticks([1, 2, 5, 10, 20, 50, 100], ["≤ 1", "2", "5", "10", "20", "50", "100"])
        axes.minorticks_off()
        axes.set_xlim(1, CASES[case].budget)
        axes.set_xlabel("executions of S")
        axes.grid(alpha=0.25)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2, fontsize=8, frameon=False)
    panels[0].set_ylabel("regret, median over seeds [% of d*]")
    figure.suptitle(f"{CASES[case].title}, {CASES[case].dimension}-D", fontsize=11)
    save(figure, f"{case}.png")


def draw_regret(axes: Axes, cell: Cell, at: int) -> None:
    """Draw one method; its markers are shifted against those of the others."""
    middle = np.maximum(np.median(cell.regrets(), axis=0), CLOSEST)
    look, every = style(cell.method), max(1, cell.budget // 8)
    axes.step(
        np.arange(1, cell.budget + 1),
        middle,
        where="post",
        color=look.colour,
        linestyle=look.line,
        linewidth=2.0 if cell.method == "scalar" else 1.5,
        marker=look.marker,
        markersize=5,
        markevery=((at * every) // 10, every),
        label=METHODS[cell.method].title,
    )


def draw_executions(percent: float = 5) -> None:
    """Draw the executions until so close to d*, median and quartiles, a panel for each function."""
    names = list(METHODS)
    drawn = [case for case in CASES if cells(case)]
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    panels = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
    for axes, case in zip(panels, drawn, strict=True):
        for cell in cells(case):
            draw_reached(axes, cell, len(names) - names.index(cell.method), percent)
        axes.axvline(CASES[case].budget, color="#000000", linewidth=0.8, linestyle=(0, (6, 4)))
        axes.set_xscale("log")
        axes.set_xlim(0.8, 2.2 * CASES[case].budget)
        axes.set_xticks([1, 3, 10, 30, 100], ["1", "3", "10", "30", "100"])
        axes.minorticks_off()
        axes.set_title(f"{CASES[case].title}, {CASES[case].dimension}-D", fontsize=9)
        axes.set_xlabel("executions of S")
        axes.grid(alpha=0.25)
    panels[0].set_yticks(range(len(names), 0, -1), [METHODS[name].title for name in names], fontsize=8)
    looks: list[tuple[str, dict[str, Any]]] = [
        ("ours: median and quartiles over the seeds", {"marker": "o", "color": "#0072b2", "linewidth": 2}),
        ("others", {"marker": "s", "color": "#d55e00", "linewidth": 1.2}),
        (
            "half of the seeds never got there",
            {"marker": "s", "color": "#d55e00", "markerfacecolor": "white", "linewidth": 0},
        ),
        ("budget", {"color": "#000000", "linewidth": 0.8, "linestyle": (0, (6, 4))}),
    ]
    handles = [panels[0].plot([], [], label=label, **look)[0] for label, look in looks]
    figure.legend(
        handles=handles, loc="outside upper center", ncols=4, fontsize=9, title=f"Executions to {percent:g} % of d*"
    )
    save(figure, "executions.png")


def draw_reached(axes: Axes, cell: Cell, height: int, percent: float) -> None:
    """Draw median and quartiles of one method; what was not reached is beyond the budget."""
    counts, beyond = cell.first_within(percent), 1.5 * CASES[cell.case].budget
    low, high = np.minimum(np.quantile(counts, [0.25, 0.75], method="inverted_cdf"), beyond)
    middle = statistics.median(counts)
    ours = METHODS[cell.method].module == "ours" and cell.method not in ("cma-es", "random")
    colour = "#0072b2" if ours else "#d55e00"
    axes.plot([low, high], [height, height], color=colour, linewidth=2 if ours else 1.2)
    face = "white" if np.isinf(middle) else colour
    marker = "o" if ours else "s"
    axes.plot(min(middle, beyond), height, marker, color=colour, markerfacecolor=face, markersize=5.5)


def draw_overhead() -> None:
    """Draw CPU seconds of a suggestion against how many values are known."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    panels = figure.subplots(1, len(PANELS), sharey=True)
    counts = (*COUNTS, 1000)
    for axes, (title, names) in zip(panels, PANELS.items(), strict=True):
        for name in names:
            draw_seconds(axes, name, counts)
        axes.set_title(title, fontsize=10)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlim(15, 1400)
        axes.set_xticks(counts, [str(n) for n in counts])
        axes.minorticks_off()
        axes.set_xlabel("values known")
        axes.grid(alpha=0.25)
        if axes.lines:
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2, fontsize=8, frameon=False)
    panels[0].set_ylabel("CPU time of a suggestion [s]")
    save(figure, "overhead.png")


def draw_seconds(axes: Axes, name: str, counts: tuple[int, ...]) -> None:
    """Draw one method, where it was measured."""
    known = [(n, max(value, 1e-5)) for n in counts if (value := seconds("linear-10", name, n)) is not None]
    if known:
        look, label = style(name), METHODS[name].title
        axes.plot(*zip(*known, strict=True), color=look.colour, linestyle=look.line, marker=look.marker, label=label)


def draw() -> None:
    """Draw all of them."""
    for case in CASES:
        if cells(case):
            draw_regrets(case)
    draw_executions()
    draw_overhead()
