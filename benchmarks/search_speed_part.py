"""The part of ``docs/searches.md`` on the CPU time of suggestions. Nothing is run here."""

from __future__ import annotations

import statistics

from landed import LANDED, STORED, Ratio
from page_tables import table

TEXT = """## CPU time beside an earlier revision

`make bench` runs each script with the code of commit {landed} and with that of today, one after the other; the option
`--store` of a script stores its figures for this table. They are processor seconds on one thread, medians over the
repeats. Other programs ran on the machine, so the ratios tell more than the seconds. In parentheses are the smallest
and the largest ratio of a repeat.

{beside}

{growth}
"""

GROWTH = """The next table gives processor seconds of a suggestion with 1,000 trials of 100 steps beside those with 50
trials ([bench_suggestion.py](../benchmarks/bench_suggestion.py)). If the dynamics are rough, they cannot be learned, so
that `auto` compares three models for each suggestion.

{table}"""


def text() -> str:
    """Return the part; without stored ratios it is empty."""
    found = [Ratio(**record) for record in STORED.values()]
    if not found:
        return ""
    growing = [one for one in found if one.benchmark == "bench_suggestion"]
    growth = table(["case", "1,000 trials", "50 trials", *RATIO], [cells(one) for one in growing])
    beside = table(["case", "before", "now", *RATIO], [cells(one) for one in found if one not in growing])
    return TEXT.format(landed=LANDED, beside=beside, growth=GROWTH.format(table=growth) if growing else "")


RATIO = ["ratio", "asked", "met"]


def cells(ratio: Ratio) -> list[str]:
    """Return the cells of a row."""
    seconds = [f"{statistics.median(times):.3g}" for times in (ratio.slow, ratio.fast)]
    spread = f" ({min(ratio.each):.1f} to {max(ratio.each):.1f})" if ratio.slow[1:] else ""
    met = ("yes" if ratio.met else "**no**") if ratio.asked else "-"
    return [ratio.figure, *seconds, f"{ratio.value:.1f}{spread}", ratio.asked or "-", met]
