"""The picture of a comparison: facts and bounds of d*, and the differences of expected distances."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.texts import shortened
from ctxval.comparison.result import Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours survive colour blindness; the markers survive grey print.
_BLUE, _ORANGE, _GREY = "#0072B2", "#D55E00", "#707070"


def picture(comparison: Comparison) -> Figure:
    """Return a figure with a panel for each question."""
    rows = max(len(comparison.candidates), len(comparison.pairs) // max(1, len(comparison.questions)))
    panels = len(comparison.questions)
    from matplotlib.figure import Figure  # imported here: loading it takes longer than a short comparison

    figure = Figure(figsize=(5.2 * panels, 1.9 + 0.42 * rows), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    for ax, question in zip(axes, comparison.questions, strict=True):
        (_worst if question == "worst" else _mean)(ax, comparison)
    return figure


def _worst(ax: Axes, comparison: Comparison) -> None:
    """Draw the largest executed distance of each candidate, and the bound on its d* if there is one."""
    ax.set_title("largest distance d*")
    for row, one in enumerate(comparison.candidates):
        if one.largest is not None:
            ax.plot(one.largest, row, "o", color=_BLUE, label="largest executed distance" if not row else None)
        if one.largest is not None and one.bound is not None:
            ax.plot([one.largest, one.bound], [row, row], "-", color=_GREY, linewidth=1.5)
        if one.bound is not None:
            ax.plot(one.bound, row, "|", color=_ORANGE, markersize=14, markeredgewidth=2.5)
    ax.plot([], [], "|", color=_ORANGE, markersize=12, markeredgewidth=2.5, label="bound on d*")
    known = [
        value
        for candidate in comparison.candidates
        for value in (candidate.largest, candidate.bound)
        if value is not None
    ]
    ax.set_xlim(0, 1.08 * max(known, default=1.0) or 1.0)
    _finish(ax, [candidate.name for candidate in comparison.candidates], "distance", comparison)


def _mean(ax: Axes, comparison: Comparison) -> None:
    """Draw the confidence sequence of each difference of expected distances."""
    pairs = [pair for pair in comparison.pairs if pair.question == "mean"]
    ax.set_title("difference of expected distances")
    ax.axvline(0.0, color="black", linewidth=1)
    finite = [
        abs(end)
        for pair in pairs
        for end in (pair.low, pair.high, pair.estimate)
        if end is not None and np.isfinite(end)
    ]
    reach = 1.15 * max(finite, default=1.0) or 1.0
    ax.plot([], [], "o-", color=_BLUE, label="decided")
    ax.plot([], [], "s--", color=_GREY, markerfacecolor="white", label="undecided")
    for row, pair in enumerate(pairs):
        low, high = (reach if end is None else end for end in (pair.low, pair.high))
        decided = pair.smaller is not None
        colour, line, marker = (_BLUE, "-", "o") if decided else (_GREY, "--", "s")
        ax.plot(np.clip([low, high], -2 * reach, 2 * reach), [row, row], line, color=colour, linewidth=2)
        if pair.estimate is not None:
            ax.plot(pair.estimate, row, marker, color=colour, markerfacecolor=colour if decided else "white")
    _finish(ax, [f"{_short(pair.first)} - {_short(pair.second)}" for pair in pairs], "difference", comparison)
    ax.set_xlim(-reach, reach)
    ax.locator_params(axis="x", nbins=5)


def _finish(ax: Axes, names: list[str], label: str, comparison: Comparison) -> None:
    """Name the rows and the axis, and add the legend."""
    ax.set_yticks(range(len(names)), [_short(name) for name in names])
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.grid(axis="x", alpha=0.25)
    ax.set_xlabel(f"{label} [{comparison.units}]" if comparison.units else label)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=2, fontsize=8, frameon=False)


def _short(name: str) -> str:
    return shortened(name, 24)
