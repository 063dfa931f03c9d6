"""The part of ``docs/calibration.md`` on campaigns that ran until they were decided. Nothing is run here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.stats import beta

from calibrate import FAMILIES, SYSTEMS
from calibrate_verdicts import BUDGETS, DRIVEN, FRESH, HARD, LOTS, RULE, SEARCHES, SHARES, decisions
from calibration_functions import DEVELOPMENT, DIMENSIONS, REPORTING

TRIED = """The next table compares possible remedies. They were tried on 14 false validations. Of these, 5 have a cusp
in a corner, 8 are other functions in one dimension (jumps and chirps), and 1 is another function in two dimensions (a
narrow peak). The last column is the number of additional executions from 8, 12 and 20 random trials on in 1-D, 2-D and
3-D. The covering takes 1.3, 17.7 and 78.7 executions in any case.

| remedy | cusps | others | additional executions |
| --- | --- | --- | --- |
| corners within an eighth of the resolution (adopted) | 5 of 5 | 0 of 9 | 1, 1, 2.2 |
| corners within half of the resolution | 2 of 5 | 0 of 9 | 0.5, 0.5, 1.5 |
| the same, and edges within three quarters | 2 of 5 | 0 of 9 | 0.5, 5.8, 44 |
| all tasks within 0.8 of the resolution | 1 of 5 | 2 of 9 | 1, 12, - |
| two tests at places of the highest draws of d* (adopted) | - | 3 of 9 | 2, 2, 2 |
| the same, but every other test at the farthest of these places | - | 4 of 9 | 2, 2, 2 |

The remaining failures are peaks and jumps in the middle of the largest gaps that the resolution permits. In one
dimension, such a gap is a quarter of the range. Tests find those peaks and jumps of which the trials show a trace."""

TEXT = """## Verdicts of campaigns that run until decided

These campaigns run as `ctxval run` does. Before anything is validated, they execute the corners and the tasks that
are far from all trials, and they test the bound twice. The budget is at most {budgets}. One threshold is below d*, so
`validated` is false. The other threshold is above d*, so nothing can be falsified.

The functions of this section were written down before any of them was run, and no choice was made with them
(`REPORTING` in `benchmarks/calibration_functions.py`). The parentheses contain the share of false verdicts, and the
upper limit of this share with confidence 97.5 %.

{families}

By search: {searches}. The target is 5 % with an upper limit of 7 %, and less than 10 % in each family.

{before}

These functions are easier than the functions below, some of which were built to be missed. Here, the search falsifies
most campaigns before the covering starts.

{verdict_table}

In two and three dimensions, the tasks that are far from all trials are executed in batches of {lots}, as with that many
workers. In three dimensions, a campaign ends as undecided once the budget is too small to come near every task. All of
this was run before bounds close to a threshold took more draws (`settle_maxima`). That rule withholds validations that
depend on the random draws.

### Functions used for the design of the rule

`before`: a campaign was validated once every task was within the resolution. Corners were treated like all other tasks,
and there were no tests. The prior, the resolution, the corner rule and the tests were chosen with these functions. The
table therefore shows what prevents false verdicts, and it is not evidence of how often they occur. Most of the
campaigns that were false before were run again.

{chosen}

{tried}

The next table has other functions of the hardest families, with seeds from {fresh} on. No choice was made with these
functions:

{hard}

The one false verdict is a chirp in one dimension with gp-ucb. The search placed half of its executions on the second
highest wave. The trials at 0 and 0.13 are both half as high as d*, and the highest wave is between them.

### Cost of the rule

The paper's systems were searched by `auto` with tau = {above:g} d*. The seeds are the same before and now.

{price}
"""


def until_decided() -> str:
    """Return the part of the page."""
    reported = decided((family, d) for family in REPORTING for d in DIMENSIONS)
    return TEXT.format(
        budgets=", ".join(f"{budget} executions in {d}-D" for d, budget in BUDGETS.items()),
        lots=" and ".join(f"{LOTS[d]}" for d in DIMENSIONS[1:]),
        families=family_table(reported),
        searches=search_summary(reported),
        before=before_summary(),
        verdict_table=verdict_table(reported),
        chosen=chosen_table(),
        tried=TRIED,
        fresh=FRESH,
        hard=family_table(_of_seeds(decided((family, d) for family in HARD for d in DIMENSIONS), fresh=True)),
        above=SHARES[1],
        price=price_table(),
    ).rstrip()


def interval(missed: int, total: int) -> tuple[float, float]:
    """Return the 95 % Clopper-Pearson interval of a coverage in per cent."""
    low = beta.ppf(0.025, total - missed, missed + 1) if missed < total else 0.0
    high = beta.ppf(0.975, total - missed + 1, missed) if missed else 1.0
    return 100 * float(low), 100 * float(high)


def validated_share(answers: list[str]) -> dict[str, float]:
    """Return how many of these answers are false validations, of how many, and the 95 % interval in per cent."""
    false = answers.count("validated")
    low, high = interval(len(answers) - false, len(answers)) if answers else (0.0, 100.0)
    return {"false": false, "below": len(answers), "low": low, "high": high}


def table(header: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


Found = dict[tuple[str, int, str], list[dict[str, Any]]]
"""Campaigns that ran until they were decided, by family, dimension and search."""


def decided(names: Iterable[tuple[str, int]], rule: int = RULE) -> Found:
    """Return the stored campaigns that ran by a rule of coverage."""
    found: Found = {}
    for family, d in names:
        for result in decisions(family, d, rule):
            found.setdefault((family, d, result["search"]), []).append(result)
    return dict(sorted(found.items(), key=lambda item: item[0][1]))


def verdict_table(found: Found) -> str:
    """Return what campaigns answered that ran until they were decided."""
    below, above = SHARES
    rows = []
    for (family, d, search), results in found.items():
        false = [result for result in results if result["share"] == below]
        true = [result for result in results if result["share"] == above]
        rows.append([family, f"{d}-D", search, *_answers(false, "validated"), *_answers(true, "undecided")])
    return table(
        [
            *("function", "", "search"),
            *(f"tau = {below:g} d*: falsely validated", "executions"),
            *(f"tau = {above:g} d*: left undecided", "executions"),
        ],
        rows,
    )


def _answers(results: list[dict[str, Any]], wrong: str) -> tuple[str, str]:
    """Return how many gave the answer that they should not, and quartiles of the executions."""
    if not results:
        return "-", "-"
    count = sum(result["answer"] == wrong for result in results)
    return f"{count} of {len(results)}", _quartiles(results)


def _quartiles(results: list[dict[str, Any]]) -> str:
    low, middle, high = np.quantile([result["executions"] for result in results], [0.25, 0.5, 0.75])
    return f"{middle:.3g} ({low:.3g} to {high:.3g})"


def _of_seeds(found: Found, *, fresh: bool) -> Found:
    """Return the campaigns on functions by which nothing was chosen, or on the others."""
    return {key: [result for result in results if (result["seed"] >= FRESH) == fresh] for key, results in found.items()}


def _below(
    found: Found, family: str | None = None, dimension: int | None = None, search: str | None = None
) -> list[dict[str, Any]]:
    """Return the campaigns with a threshold below d*, of a family, dimension and search where they are given."""
    wanted = (family, dimension, search)
    results = [
        result
        for key, of_key in found.items()
        if all(asked in (None, own) for asked, own in zip(wanted, key, strict=True))
        for result in of_key
    ]
    return [result for result in results if result["share"] == SHARES[0]]


def false_of(results: list[dict[str, Any]]) -> tuple[int, str]:
    """Return how many were validated falsely, and that in words with the 97.5 % limit (Clopper and Pearson)."""
    false = sum(result["answer"] == "validated" for result in results)
    if not results:
        return 0, "-"
    most = 100 - interval(false, len(results))[0]
    return false, f"{false} of {len(results)} ({100 * false / len(results):.2g} %, at most {most:.2g} %)"


def family_table(found: Found) -> str:
    """Return how many verdicts were false, family by family, with limits of 97.5 % confidence."""
    rows = []
    for family in [*dict.fromkeys(family for family, _, _ in found), None]:
        parts = [_below(found, family, d) for d in (*DIMENSIONS, None)]
        rows.append([family or "all", *(false_of(part)[1] for part in parts)])
    return table(["function", *(f"{d}-D" for d in DIMENSIONS), "all"], rows)


def search_summary(found: Found) -> str:
    """Return how many verdicts were false, search by search."""
    return "; ".join(f"{search}: {false_of(_below(found, search=search))[1]}" for search in SEARCHES)


def before_summary() -> str:
    """Return how many verdicts were false on the same functions before the rule."""
    results = _below(decided(((family, d) for family in REPORTING for d in DIMENSIONS), 1))
    return (
        f"Without the corner rule and the tests: {false_of(results)[1]}, in one and two dimensions. (Campaigns that "
        "are falsified before the covering starts are the same with and without them, and were run once.)"
    )


def chosen_table() -> str:
    """Return false verdicts on the functions that the rule was chosen by, before it and now."""
    names = [(family, d) for family in [*FAMILIES, *DEVELOPMENT] for d in DIMENSIONS]
    before, now = decided(names, 1), _of_seeds(decided(names), fresh=False)
    rows = []
    for family, d in dict.fromkeys(key[:2] for key in before):
        old = _below(before, family, d)
        if not old:
            continue
        text = false_of(old)[1]
        again = _below(now, family, d)
        still = sum(result["answer"] == "validated" for result in again)
        rows.append([family, f"{d}-D", text, f"{still} of {len(again)}" if again else "-"])
    return table(["function", "", "before: falsely validated", "of these, false now"], rows)


def price_table() -> str:
    """Return what a verdict above d* costs on the paper's systems, before the rule and now, of the same seeds."""
    rows, above = [], SHARES[1]
    for name in DRIVEN:
        d = SYSTEMS[name].dimension
        now = [line for line in decisions(name, d) if line["share"] == above]
        seeds = {line["seed"] for line in now}
        before = [line for line in decisions(name, d, 1) if line["share"] == above and line["seed"] in seeds]
        if now:
            was, left = _answers(before, "undecided"), _answers(now, "undecided")
            rows.append([name, f"{d}-D", was[0], was[1], left[0], left[1]])
    header = ["before: left undecided", "executions", "now: left undecided", "executions"]
    return table(["system", "", *header], rows)
