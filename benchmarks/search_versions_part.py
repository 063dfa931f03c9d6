"""The table of ``docs/searches.md`` on `auto` with the code of an earlier commit. Nothing is run here."""

from __future__ import annotations

from search_cells import ENDS, cells, results
from study_auto import CASES, Result, first_within

BEFORE, AFTER = "auto_before", "auto"
"""Files of results: of the code of an earlier commit, and of the code of today."""

HEADER = ["case", "seeds", "code", *ENDS, "fewer / more"]


def rows() -> list[list[str]]:
    """Return the campaigns with the code of an earlier commit and with that of today, on the seeds that both have."""
    return [row for case in CASES for row in rows_of(case)]


def total() -> tuple[int, int]:
    """Return in how many campaigns the code of today needs fewer and more executions to 1 % of d*."""
    counts = [row[-1].split(" / ") for row in rows() if row[-1]]
    return sum(int(fewer) for fewer, _ in counts), sum(int(more) for _, more in counts)


def rows_of(case: str) -> list[list[str]]:
    """Return the two rows of a case; none if the earlier code has not run on it."""
    before, after = results(BEFORE, case, "auto"), results(AFTER, case, "auto")
    common = sorted(before.keys() & after.keys())
    if not common:
        return []
    earlier, now = [before[seed] for seed in common], [after[seed] for seed in common]
    return [
        [case, str(len(common)), "before", *cells(earlier), ""],
        [case, str(len(common)), "after", *cells(now), fewer_and_more(earlier, now)],
    ]


def fewer_and_more(earlier: list[Result], now: list[Result]) -> str:
    """Return in how many campaigns the code of today needs fewer and more executions to 1 % of d*."""
    counts = [(first_within(old, 1.0), first_within(new, 1.0)) for old, new in zip(earlier, now, strict=True)]
    return f"{sum(new < old for old, new in counts)} / {sum(new > old for old, new in counts)}"
