"""The tables of a comparison, for the command line and as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ctxval._util.files import MADE_BY
from ctxval._util.texts import markdown_text
from ctxval.certificates.bounds import at_most
from ctxval.comparison.result import WORDS, Comparison

CANDIDATES = ("candidate", "executions", "shared", "largest distance", "bound on d*", "draws", "mean distance")
"""The columns of the table of candidates."""

PAIRS = ("question", "smaller", "than", "difference", "interval", "tasks")
"""The columns of the table of pairs."""


def candidate_rows(comparison: Comparison) -> list[tuple[str, ...]]:
    """Return a row for each candidate, as texts."""
    rows: list[tuple[str, ...]] = []
    for known in comparison.candidates:
        bound = "-" if known.bound is None else _number(float(at_most(known.bound)))
        counts = str(known.executions), str(known.shared)
        rows.append((known.name, *counts, _number(known.largest), bound, str(known.draws), _number(known.mean)))
    return rows


def pair_rows(comparison: Comparison) -> list[tuple[str, ...]]:
    """Return a row for each pair and question, as texts."""
    rows: list[tuple[str, ...]] = []
    for pair in comparison.pairs:
        names = (f"{pair.first} ? {pair.second}", "undecided")
        if pair.smaller is not None:
            names = (pair.smaller, pair.larger)
        cells = ("-", "-", "-")
        if pair.question == "mean":
            sign = -1 if pair.smaller == pair.second else 1  # of the smaller one minus the other one
            ends = sorted(sign * end for end in (pair.low, pair.high) if end is not None)
            interval = f"{_number(ends[0])} to {_number(ends[1])}" if len(ends) == 2 else "-"
            cells = (_number(None if pair.estimate is None else sign * pair.estimate), interval, str(pair.tasks))
        rows.append((WORDS[pair.question], *names, *cells))
    return rows


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
