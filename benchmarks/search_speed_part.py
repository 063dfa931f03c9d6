"""The part of ``docs/searches.md`` on the CPU time of suggestions. Nothing is run here."""

from __future__ import annotations

import statistics

from landed import LANDED, STORED, Ratio
from page_tables import Table, table

TEXT = """## CPU time in comparison with an earlier revision

`make bench` runs each script with the code of commit {landed} and with the present code, one after the other:
processor seconds on one thread, medians over the repeats, with the smallest and largest ratio. Other programs ran on
the machine. {met} of {asked} requested ratios are met; these are not:

{missed}

[All figures](tables/searches-speed.csv). A suggestion with 1,000 trials of 100 steps takes, in comparison with 50
trials ([bench_suggestion.py](../benchmarks/bench_suggestion.py)): {growth}."""


def part() -> tuple[str, dict[str, Table]]:
    """Return the part of the page and its table."""
    found = [Ratio(**record) for record in STORED.values()]
    growing = [one for one in found if one.benchmark == "bench_suggestion"]
    rows = [cells(one) for one in found if one not in growing]
    asked = [row for row in rows if row[-1] != "-"]
    header = ["case", "before", "now", *RATIO]
    text = TEXT.format(
        landed=LANDED,
        met=sum(row[-1] == "yes" for row in asked),
        asked=len(asked),
        missed=table(header[:-1], [row[:-1] for row in asked if row[-1] != "yes"]),
        growth=", ".join(f"{row[3]} times for {row[0]} ({row[4]})" for row in map(cells, growing)),
    )
    return text, {"searches-speed": (header, rows)}


RATIO = ["ratio", "asked", "met"]


def cells(ratio: Ratio) -> list[str]:
    """Return the cells of a row."""
    seconds = [f"{statistics.median(times):.3g}" for times in (ratio.slow, ratio.fast)]
    spread = f" ({min(ratio.each):.1f} to {max(ratio.each):.1f})" if ratio.slow[1:] else ""
    met = ("yes" if ratio.met else "**no**") if ratio.asked else "-"
    return [ratio.figure, *seconds, f"{ratio.value:.1f}{spread}", ratio.asked or "-", met]
