"""What the tables of the page on searches share: stored campaigns, and what their cells say."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import numpy as np

from json_lines import JsonLines
from study_auto import WITHIN, Result, first_within, results_of, shown

SEEDS = range(10)
ENDS_OF = (WITHIN[0], WITHIN[-1])
"""The percentages of d* that tables show."""

Counts = list[float]
"""Executions to somewhere, seed by seed; infinity where the budget did not suffice."""


@functools.cache
def results_read(study: str) -> JsonLines:
    """Return the results of a study; they are read once."""
    return results_of(study)


def results(study: str, case: str, search: str, seeds: Iterable[int] = SEEDS) -> dict[int, Result]:
    """Return the stored campaigns of a case and a search, by their seeds."""
    stored = results_read(study)
    return {seed: stored[case, seed, search] for seed in seeds if (case, seed, search) in stored}


def largest(result: Result) -> float:
    """Return the largest distance of a campaign."""
    return max(distance or 0.0 for distance in result["distances"])


def spread(counts: Counts, budget: int) -> str:
    """Return the quartiles, each the number of one seed."""
    low, high = np.quantile(counts, [0.25, 0.75], method="inverted_cdf")
    return f"{shown(float(low), budget)} to {shown(float(high), budget)}"


def reached(counts: Counts) -> str:
    """Return how many seeds got there."""
    return f"{int(np.isfinite(counts).sum())} of {len(counts)}"


def cells(found: Iterable[Result]) -> list[str]:
    """Return medians with quartiles and how many seeds got there, for 5 and 1 %, and the share of d* in the end."""
    campaigns = list(found)
    budget = campaigns[0]["budget"]
    row = []
    for percent in ENDS_OF:
        counts = [first_within(result, percent) for result in campaigns]
        row.append(f"{shown(float(np.median(counts)), budget)} ({spread(counts, budget)}), {reached(counts)}")
    shares = [100 * largest(result) / result["truth"] for result in campaigns]
    return [*row, f"{np.median(shares):.1f} % ({min(shares):.1f})"]


ENDS = ["5 %: median (25 to 75 %), reached", "1 %: median (25 to 75 %), reached", "best found: median (least)"]
