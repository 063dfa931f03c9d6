"""The result of a comparison: what is known of each candidate, and the decision on each pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval._util.files import MADE_BY
from ctxval._util.representation import ShortRepr, call, line, lines
from ctxval._util.representation import table as html_table
from ctxval._util.texts import markdown_text, shortened
from ctxval.certificates.bounds import at_most
from ctxval.core.space import Point
from ctxval.studies.comparison.candidates import Question

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# What each question is about, and the columns of the tables of candidates and of pairs.
WORDS: dict[Question, str] = {"worst": "largest distance d*", "mean": "expected distance"}
CANDIDATES = ("candidate", "executions", "shared", "largest distance", "bound on d*", "draws", "mean distance")
PAIRS = ("question", "smaller", "than", "difference", "interval", "tasks")


@dataclass(frozen=True)
class CandidateResult(ShortRepr):
    """What is known of one candidate; a value that is not known is None."""

    name: str
    executions: int  #: the number of executions that were made for it
    shared: int  #: the number of executions of other candidates that count for it too, because its controllers agree
    failed: int  #: how many of its executions failed
    largest: float | None  #: the largest executed distance, and the parameters of this task
    task: dict[str, Point] | None
    bound: float | None  #: what d* is at most, if a decision needed it
    draws: int  #: the number of its independent draws, and the mean of their distances
    mean: float | None

    @property
    def cells(self) -> tuple[str, ...]:
        """The row of the table of candidates."""
        bound = None if self.bound is None else float(at_most(self.bound))
        counts = str(self.executions), str(self.shared)
        return self.name, *counts, _number(self.largest), _number(bound), str(self.draws), _number(self.mean)


@dataclass(frozen=True)
class PairResult:
    """The decision on one question about two candidates."""

    question: Question
    first: str
    second: str
    smaller: str | None  #: the name of the one with the smaller value; None if this is not decided
    reason: str  #: why, or what is missing, in one sentence
    estimate: float | None = None  #: the expected distance of the first minus that of the second, and its interval
    low: float | None = None
    high: float | None = None
    tasks: int = 0  #: the number of tasks that both have executed for it
    variance_left: float | None = None  #: the variance that the predictions leave of the differences, as a share

    @property
    def larger(self) -> str:
        """The name of the one with the larger value, if this is decided."""
        return self.second if self.smaller == self.first else self.first

    @property
    def cells(self) -> tuple[str, ...]:
        """The row of the table of pairs; the difference is that of the smaller one minus the other one."""
        names = self.smaller or f"{self.first} ? {self.second}", self.larger if self.smaller else "undecided"
        if self.question != "mean":
            return WORDS[self.question], *names, "-", "-", "-"
        sign = -1 if self.smaller == self.second else 1
        ends = sorted(sign * end for end in (self.low, self.high) if end is not None)
        is_limited = len(ends) == 2 and np.isfinite(ends).any()
        interval = f"{_number(ends[0])} to {_number(ends[1])}" if is_limited else "-"
        estimate = _number(None if self.estimate is None else sign * self.estimate)
        return WORDS[self.question], *names, estimate, interval, str(self.tasks)

    def __repr__(self) -> str:
        return lines(call(self, self.question, self.first, self.second, smaller=self.smaller), line(self.reason))


@dataclass(frozen=True)
class Comparison:
    """The result of a comparison."""

    candidates: tuple[CandidateResult, ...]
    pairs: tuple[PairResult, ...]
    confidence: float  #: the probability with which all decisions and intervals hold together
    executions: int  #: the number of executions of the system, and the largest one; a shared one counts once
    budget: int
    units: str  #: the units of the distances
    assumptions: tuple[str, ...]  #: what the decisions assume, one sentence each

    @property
    def decided(self) -> bool:
        """Whether all pairs are decided, for all questions."""
        return all(pair.smaller is not None for pair in self.pairs)

    @property
    def questions(self) -> tuple[Question, ...]:
        """The questions, in their order."""
        return tuple(dict.fromkeys(pair.question for pair in self.pairs))

    def pair(self, question: Question, first: str, second: str) -> PairResult:
        """Return the decision on a pair, named in any order."""
        by_names = {(pair.question, frozenset((pair.first, pair.second))): pair for pair in self.pairs}
        return by_names[question, frozenset((first, second))]

    def ranking(self, question: Question) -> tuple[tuple[str, ...], ...]:
        """Return groups of candidates from the smallest value to the largest; all pairs between groups are decided."""
        smaller = {(pair.smaller, pair.larger) for pair in self.pairs if pair.question == question and pair.smaller}
        wins = {candidate.name: sum(first == candidate.name for first, _ in smaller) for candidate in self.candidates}
        ordered = sorted((candidate.name for candidate in self.candidates), key=lambda name: -wins[name])
        groups, start = list[tuple[str, ...]](), 0
        for end in range(1, len(ordered) + 1):
            if all((a, b) in smaller for a in ordered[start:end] for b in ordered[end:]):
                groups.append(tuple(ordered[start:end]))
                start = end
        return tuple(groups)

    def ranking_text(self, question: Question) -> str:
        """Return the ranking in one line, such as ``gp < fnn < linear``; ``?`` joins those that are not told apart."""
        return " < ".join(" ? ".join(group) for group in self.ranking(question))

    def to_json(self) -> dict[str, Any]:
        """Return everything in types that JSON has: an infinite end of an interval is None."""
        plain = asdict(self)
        for pair in plain["pairs"]:
            for end in ("low", "high"):
                pair[end] = pair[end] if pair[end] is not None and np.isfinite(pair[end]) else None
        return {**plain, "decided": self.decided, "rankings": {q: self.ranking(q) for q in self.questions}}

    def to_markdown(self) -> str:
        """Return the tables, the reasons and the assumptions as Markdown."""

        def table(*rows: Sequence[str]) -> str:
            whole = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
            return "\n".join(f"| {' | '.join(map(markdown_text, cells))} |" for cells in whole)

        units = f" The distances are in {markdown_text(self.units)}." if self.units else ""
        rankings = ((WORDS[question].capitalize(), self.ranking_text(question)) for question in self.questions)
        reasons = ((", ".join(map(markdown_text, (pair.first, pair.second))), pair.reason) for pair in self.pairs)
        parts = [
            "## Comparison",
            "\n".join(f"- {what}: {markdown_text(ranking)}" for what, ranking in rankings),
            f"{self.executions} executions of at most {self.budget}. All decisions hold together with confidence "
            f"{self.confidence:.6g}.{units}",
            table(CANDIDATES, *(candidate.cells for candidate in self.candidates)),
            table(PAIRS, *(pair.cells for pair in self.pairs)),
            "\n".join(f"- {names}: {markdown_text(reason)}." for names, reason in reasons),
            "It assumes that",
            "\n".join(f"- {markdown_text(assumption)};" for assumption in self.assumptions),
            f"<!-- {MADE_BY} -->",
        ]
        return "\n\n".join(parts) + "\n"

    def plot(self) -> Figure:
        """Return a figure with a panel for each question: executed distances, bounds and intervals."""
        from matplotlib.figure import Figure  # imported here: loading it takes longer than a short comparison

        panels = len(self.questions)
        rows = max(len(self.candidates), len(self.pairs) // max(1, panels))
        figure = Figure(figsize=(5.2 * panels, 1.9 + 0.42 * rows), layout="constrained")
        for ax, question in zip(figure.subplots(1, panels, squeeze=False)[0], self.questions, strict=True):
            names, label = (_draw_worst if question == "worst" else _draw_mean)(ax, self)
            ax.set_yticks(range(len(names)), [shortened(name, 24) for name in names])
            ax.set_ylim(len(names) - 0.5, -0.5)
            ax.grid(axis="x", alpha=0.25)
            ax.set_xlabel(f"{label} [{self.units}]" if self.units else label)
            ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=2, fontsize=8, frameon=False)
        return figure

    def __repr__(self) -> str:
        known = {name: getattr(self, name) for name in ("confidence", "executions", "budget", "decided")}
        rankings = (f"{WORDS[question]}: {line(self.ranking_text(question))}" for question in self.questions)
        return lines(call(self, **known), *rankings)

    def _repr_html_(self) -> str:
        rows = [
            *((WORDS[question], self.ranking_text(question)) for question in self.questions),
            *((f"{pair.first}, {pair.second}", pair.reason) for pair in self.pairs),
            ("executions", f"{self.executions} of at most {self.budget}"),
            ("confidence of all decisions together", self.confidence),
            *(("assumes", assumption) for assumption in self.assumptions),
        ]
        return html_table("Comparison", rows)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if np.isfinite(value) else ("unlimited" if value > 0 else "-unlimited")


# Okabe and Ito's colours survive colour blindness; the markers survive grey print.
_BLUE, _ORANGE, _GREY = "#0072B2", "#D55E00", "#707070"


def _draw_worst(ax: Axes, comparison: Comparison) -> tuple[list[str], str]:
    """Draw the largest executed distance and the bound on d* of each candidate; return its rows and its label."""
    ax.set_title("largest distance d*")
    for row, candidate in enumerate(comparison.candidates):
        largest, bound = candidate.largest, candidate.bound
        if largest is not None:
            ax.plot(largest, row, "o", color=_BLUE, label="largest executed distance" if not row else None)
        if largest is not None and bound is not None:
            ax.plot([largest, bound], [row, row], "-", color=_GREY, linewidth=1.5)
        if bound is not None:
            ax.plot(bound, row, "|", color=_ORANGE, markersize=14, markeredgewidth=2.5)
    ax.plot([], [], "|", color=_ORANGE, markersize=12, markeredgewidth=2.5, label="bound on d*")
    ends = [end for item in comparison.candidates for end in (item.largest, item.bound) if end is not None]
    ax.set_xlim(0, 1.08 * max(ends, default=1.0) or 1.0)
    return [candidate.name for candidate in comparison.candidates], "distance"


def _draw_mean(ax: Axes, comparison: Comparison) -> tuple[list[str], str]:
    """Draw the confidence sequence of each difference of expected distances; return its rows and its label."""
    pairs = [pair for pair in comparison.pairs if pair.question == "mean"]
    ax.set_title("difference of expected distances")
    ax.axvline(0.0, color="black", linewidth=1)
    ends = [abs(end) for pair in pairs for end in (pair.low, pair.high, pair.estimate) if end is not None]
    reach = 1.15 * max(filter(np.isfinite, ends), default=1.0) or 1.0
    ax.plot([], [], "o-", color=_BLUE, label="decided")
    ax.plot([], [], "s--", color=_GREY, markerfacecolor="white", label="undecided")
    for row, pair in enumerate(pairs):
        low, high = (reach if end is None else end for end in (pair.low, pair.high))
        decided = pair.smaller is not None
        colour, line, marker = (_BLUE, "-", "o") if decided else (_GREY, "--", "s")
        ax.plot(np.clip([low, high], -2 * reach, 2 * reach), [row, row], line, color=colour, linewidth=2)
        if pair.estimate is not None:
            ax.plot(pair.estimate, row, marker, color=colour, markerfacecolor=colour if decided else "white")
    ax.set_xlim(-reach, reach)
    ax.locator_params(axis="x", nbins=5)
    return [f"{shortened(pair.first, 24)} - {shortened(pair.second, 24)}" for pair in pairs], "difference"
