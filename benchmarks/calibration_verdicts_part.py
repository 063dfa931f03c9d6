"""The part of ``docs/calibration.md`` on campaigns that the posterior bound decides. Nothing is run here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from calibrate import FAMILIES, SYSTEMS
from calibrate_verdicts import BUDGETS, DRIVEN, FRESH, HARD, RULE, SHARES, decisions
from calibration_functions import DEVELOPMENT, DIMENSIONS, REPORTING
from page_tables import Table, share_of

TEXT = """### Verdicts of the posterior bound

These campaigns run until they are decided, with at most {budgets}. The {families} families of functions were written
down before any of them was run (`REPORTING` in `benchmarks/calibration_functions.py`).

- With a threshold of {below:g} d*, {reported} were validated falsely. Without the rule on corners and without tests
  of the bound, {before} were (1-D and 2-D). Most campaigns are falsified before the covering starts, so these
  functions are easier than the next ones.
- On new functions of the five hardest families, some of which were built to be missed, {hard} were. The false one is
  a chirp in one dimension: the search placed half of its executions on the second highest wave, and the highest one
  lies in a gap of the trials that the resolution permits.
- Before the rule on corners, up to 38 % of the campaigns on one family were validated falsely (cusps in corners). An
  execution near each corner prevents all 5 of these validations and costs 1 to 2 executions. Two tests at the
  largest draws of d* prevent 3 of the 9 others. The remaining ones are peaks and jumps in the middle of gaps.

Tables: [by family](tables/calibration-verdicts-families.csv), [by search](tables/calibration-verdicts-searches.csv),
[hard families](tables/calibration-verdicts-hard.csv), [before and after the
rule](tables/calibration-verdicts-design.csv), [remedies that were tried](tables/calibration-remedies.csv), [cost on
the paper's systems](tables/calibration-verdicts-cost.csv)."""


def until_decided() -> tuple[str, dict[str, Table]]:
    """Return the part of the page and its tables."""
    reported = decided((family, d) for family in REPORTING for d in DIMENSIONS)
    hard = _of_seeds(decided((family, d) for family in HARD for d in DIMENSIONS), fresh=True)
    before = _below(decided(((family, d) for family in REPORTING for d in DIMENSIONS), 1))
    text = TEXT.format(
        budgets=", ".join(f"{budget} executions in {d}-D" for d, budget in BUDGETS.items()),
        families=len(REPORTING),
        below=SHARES[0],
        reported=false_of(_below(reported)),
        before=false_of(before),
        hard=false_of(_below(hard)),
    )
    header = ["function", *(f"{d}-D" for d in DIMENSIONS), "all"]
    return text, {
        "calibration-verdicts-families": (header, family_rows(reported)),
        "calibration-verdicts-searches": (SEARCH_HEADER, search_rows(reported)),
        "calibration-verdicts-hard": (header, family_rows(hard)),
        "calibration-verdicts-design": (["function", "dimension", "before", "of these, false now"], design_rows()),
        "calibration-verdicts-cost": (COST_HEADER, cost_rows()),
    }


def reported_false() -> list[dict[str, Any]]:
    """Return the campaigns on the reporting functions with a threshold below d*."""
    return _below(decided((family, d) for family in REPORTING for d in DIMENSIONS))


Found = dict[tuple[str, int, str], list[dict[str, Any]]]
"""Campaigns that ran until they were decided, by family, dimension and search."""


def decided(names: Iterable[tuple[str, int]], rule: int = RULE) -> Found:
    """Return the stored campaigns that ran by a rule of coverage."""
    found: Found = {}
    for family, d in names:
        for result in decisions(family, d, rule):
            found.setdefault((family, d, result["search"]), []).append(result)
    return dict(sorted(found.items(), key=lambda item: item[0][1]))


SEARCH_HEADER = ["function", "dimension", "search", f"{SHARES[0]:g} d*: falsely validated", "executions"]


def search_rows(found: Found) -> list[list[str]]:
    """Return how often campaigns below d* were validated, and their executions."""
    rows = []
    for (family, d, search), results in found.items():
        below = [result for result in results if result["share"] == SHARES[0]]
        rows.append([family, f"{d}-D", search, *_answers(below, "validated")])
    return rows


def _answers(results: list[dict[str, Any]], wrong: str) -> tuple[str, str]:
    """Return how many gave the answer that they should not, and quartiles of the executions."""
    if not results:
        return "-", "-"
    count = sum(result["answer"] == wrong for result in results)
    low, middle, high = np.quantile([result["executions"] for result in results], [0.25, 0.5, 0.75])
    return f"{count} of {len(results)}", f"{middle:.3g} ({low:.3g} to {high:.3g})"


def _of_seeds(found: Found, *, fresh: bool) -> Found:
    """Return the campaigns on functions by which nothing was chosen, or on the others."""
    return {key: [result for result in results if (result["seed"] >= FRESH) == fresh] for key, results in found.items()}


def _below(found: Found, family: str | None = None, dimension: int | None = None) -> list[dict[str, Any]]:
    """Return the campaigns with a threshold below d*, of a family and dimension if these are stated."""
    wanted = (family, dimension)
    results = [
        result
        for key, of_key in found.items()
        if all(asked in (None, own) for asked, own in zip(wanted, key, strict=False))
        for result in of_key
    ]
    return [result for result in results if result["share"] == SHARES[0]]


def false_of(results: list[dict[str, Any]]) -> str:
    """Return how many were validated falsely, with the 97.5 % limit."""
    return share_of(sum(result["answer"] == "validated" for result in results), len(results))


def family_rows(found: Found) -> list[list[str]]:
    """Return how many verdicts were false, family by family."""
    families = [*dict.fromkeys(family for family, _, _ in found), None]
    return [
        [family or "all", *(false_of(_below(found, family, d)) for d in (*DIMENSIONS, None))] for family in families
    ]


def design_rows() -> list[list[str]]:
    """Return false verdicts on the functions that the rule was chosen by, before it and now."""
    names = [(family, d) for family in [*FAMILIES, *DEVELOPMENT] for d in DIMENSIONS]
    before, now = decided(names, 1), _of_seeds(decided(names), fresh=False)
    rows = []
    for family, d in dict.fromkeys(key[:2] for key in before):
        if old := _below(before, family, d):
            again = _below(now, family, d)
            still = sum(result["answer"] == "validated" for result in again)
            rows.append([family, f"{d}-D", false_of(old), f"{still} of {len(again)}" if again else "-"])
    return rows


COST_HEADER = ["system", "dimension", "before: left undecided", "executions", "now: left undecided", "executions"]


def cost_rows() -> list[list[str]]:
    """Return what a verdict above d* costs on the paper's systems, before the rule and now, of the same seeds."""
    rows, above = [], SHARES[1]
    for name in DRIVEN:
        d = SYSTEMS[name].dimension
        now = [line for line in decisions(name, d) if line["share"] == above]
        seeds = {line["seed"] for line in now}
        before = [line for line in decisions(name, d, 1) if line["share"] == above and line["seed"] in seeds]
        if now:
            rows.append([name, f"{d}-D", *_answers(before, "undecided"), *_answers(now, "undecided")])
    return rows
