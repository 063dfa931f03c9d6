"""The tables of a comparison, for the command line and as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ctxval._util.files import MADE_BY
from ctxval._util.texts import markdown_text
from ctxval.certificates.bounds import at_most
from ctxval.comparison.result import WORDS, CandidateResult, Comparison, PairResult

CANDIDATES = ("candidate", "executions", "shared", "largest distance", "bound on d*", "draws", "mean distance")
"""The columns of the table of candidates."""

PAIRS = ("question", "smaller", "than", "difference", "interval", "tasks")
"""The columns of the table of pairs."""


def candidate_rows(comparison: Comparison) -> list[tuple[str, ...]]:
    """Return a row for each candidate, as texts."""
    return [_candidate(one) for one in comparison.candidates]


def pair_rows(comparison: Comparison) -> list[tuple[str, ...]]:
    """Return a row for each pair and question, as texts."""
    return [_pair(one) for one in comparison.pairs]


def _candidate(one: CandidateResult) -> tuple[str, ...]:
    numbers = (one.largest, one.bound if one.bound is None else float(at_most(one.bound)))
    return (
        one.name,
        str(one.executions),
        str(one.shared),
        *map(_number, numbers),
        str(one.draws),
        _number(one.mean),
    )


def _pair(one: PairResult) -> tuple[str, ...]:
    if one.smaller is None:
        names = (f"{one.first} ? {one.second}", "undecided")
    else:
        names = (one.smaller, one.second if one.smaller == one.first else one.first)
    if one.question == "worst":
        return (WORDS[one.question], *names, "-", "-", "-")
    sign = -1 if one.smaller is not None and one.smaller == one.second else 1
    ends = sorted(sign * end for end in (one.low, one.high) if end is not None)
    interval = f"{_number(ends[0])} to {_number(ends[1])}" if len(ends) == 2 else "-"
    estimate = None if one.estimate is None else sign * one.estimate
    return (WORDS[one.question], *names, _number(estimate), interval, str(one.tasks))


def _number(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if np.isfinite(value) else ("unlimited" if value > 0 else "-unlimited")


def markdown(comparison: Comparison) -> str:
    """Return the tables, the reasons and the assumptions as Markdown."""
    units = f" The distances are in {markdown_text(comparison.units)}." if comparison.units else ""
    parts = [
        "## Comparison",
        "\n".join(
            f"- {WORDS[question].capitalize()}: {markdown_text(comparison.ranking_text(question))}"
            for question in comparison.questions
        ),
        f"{comparison.executions} executions of at most {comparison.budget}. All decisions hold together with "
        f"confidence {comparison.confidence:.6g}.{units}",
        _table(CANDIDATES, candidate_rows(comparison)),
        _table(PAIRS, pair_rows(comparison)),
        "\n".join(
            f"- {', '.join(map(markdown_text, (pair.first, pair.second)))}: {markdown_text(pair.reason)}."
            for pair in comparison.pairs
        ),
        "It assumes that",
        "\n".join(f"- {markdown_text(assumption)};" for assumption in comparison.assumptions),
        f"<!-- {MADE_BY} -->",
    ]
    return "\n\n".join(parts) + "\n"


def _table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [headers, ["---"] * len(headers), *rows]
    return "\n".join(f"| {' | '.join(map(markdown_text, cells))} |" for cells in lines)
