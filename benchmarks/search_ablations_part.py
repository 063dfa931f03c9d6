"""The tables of the page on searches that say what each part of the search ``auto`` buys."""

from __future__ import annotations

import numpy as np

import misleading
from plants import DEVELOPMENT, REPORTING
from search_cells import ENDS, ENDS_OF, cells, reached, results
from study_ablations import ABLATIONS, BUDGET, CHOSEN_BY, ON_PLANTS, OTHERS
from study_ablations import CASES as ABLATED
from study_auto import CASES, Result, first_within, repeated, shown

ABLATION_SEEDS = range(5)
SHOWN = {"no climbs": "no trust region"}
"""What the page calls an ablation, if it is not the name of its results."""


def of_ablation(case: str, without: str) -> dict[int, Result]:
    """Return the campaigns without a part, or those of `auto` itself."""
    if without != "auto" or case not in ABLATED:
        return results("ablations", case, without, ABLATION_SEEDS)
    return results("misleading" if case in misleading.CASES else "auto", case, "auto", ABLATION_SEEDS)


HEADER = ["case", "search", *ENDS]


def rows() -> list[list[str]]:
    """Return what is found without each part on cases and plants, on the seeds that all have."""
    found_rows = []
    for case in (*ABLATED, *ON_PLANTS):
        found = {without: of_ablation(case, without) for without in ("auto", *ABLATIONS)}
        found = {without: campaigns for without, campaigns in found.items() if campaigns}
        common = sorted(set.intersection(*map(set, found.values()))) if found else []
        if common and len(found) > 1:
            found_rows += [
                [case, SHOWN.get(name, name), *cells(found[name][seed] for seed in common)] for name in found
            ]
    return found_rows


def new_rows() -> list[list[str]]:
    """Return what is found on misleading systems without each part, on the campaigns that all have."""
    found_rows = []
    for group, entries in {"chosen by": CHOSEN_BY, "others": OTHERS}.items():
        found = {
            name: {(entry, seed): run for entry in entries for seed, run in results("ablations", entry, name).items()}
            for name in ("auto", *ABLATIONS)
        }
        found = {name: campaigns for name, campaigns in found.items() if campaigns}
        common = sorted(set.intersection(*map(set, found.values())))
        for name in found:
            found_rows.append([group, SHOWN.get(name, name), *together([found[name][key] for key in common])])
    return found_rows


TOGETHER = [
    *("systems", "search", "campaigns", "within 5 %", "within 1 %", "median to 5 %", "mean share of d*"),
    "next to an earlier one",
]


def together(campaigns: list[Result]) -> list[str]:
    """Return counts and means over campaigns on several systems."""
    near = [[first_within(result, percent) for result in campaigns] for percent in ENDS_OF]
    executions = sum(len(result["distances"]) for result in campaigns)
    wasted = sum(repeated(result) or 0 for result in campaigns)
    return [
        str(len(campaigns)),
        *(reached(counts) for counts in near),
        shown(float(np.median(near[0])), BUDGET),
        f"{100 * np.mean([average_share(result) for result in campaigns]):.1f} %",
        f"{wasted} of {executions}",
    ]


SUMMARY = ["without", "systems", "campaigns", "the same", *(f"{percent:g} %" for percent in ENDS_OF)]


def summary_rows() -> list[list[str]]:
    """Return, over all campaigns that were repeated without a part, how often the part saves executions."""
    groups = {"chosen by": [*ABLATED, *CHOSEN_BY, *_plants(DEVELOPMENT)], "others": [*OTHERS, *_plants(REPORTING)]}
    found = []
    for name in ABLATIONS:
        for group, systems in groups.items():
            pairs = [pair for case in systems for pair in _pairs(case, name)]
            found += [[SHOWN.get(name, name), group, *_compared(pairs)]] if pairs else []
    return found


LEFT_OUT = [
    *("systems", "campaigns", "the same", *(f"{percent:g} %: fewer / more" for percent in ENDS_OF)),
    *("mean share of d* with discrepancy", "without it"),
]


def left_out_rows() -> list[list[str]]:
    """Return what the search found when its predictions were also corrected by a discrepancy, and what it finds now."""
    groups = {
        "all cases": [(case, "auto") for case in CASES],
        "misleading cases": [(case, "misleading") for case in misleading.CASES],
        "chosen by": [(case, "ablations") for case in (*CHOSEN_BY, *_plants(DEVELOPMENT))],
        "others": [(case, "ablations") for case in (*OTHERS, *_plants(REPORTING))],
    }
    found = []
    for group, systems in groups.items():
        pairs = [pair for case, study in systems for pair in _before_and_today(case, study)]
        shares = (f"{100 * np.mean([average_share(run) for run in runs]):.1f} %" for runs in zip(*pairs, strict=True))
        found += [[group, *_compared(pairs), *shares]] if pairs else []
    return found


def _before_and_today(case: str, study: str) -> list[tuple[Result, Result]]:
    """Return the campaigns with the discrepancy and those of today, on the seeds that both have."""
    today = results(study, case, "auto")
    return [(run, today[seed]) for seed, run in results("auto_left_out", case, "discrepancy").items() if seed in today]


def _plants(kind: str) -> list[str]:
    return [name for name, plant in ON_PLANTS.items() if plant.kind == kind]


def _pairs(case: str, without: str) -> list[tuple[Result, Result]]:
    """Return the campaigns of `auto` and those without a part, on the seeds that both have."""
    whole = of_ablation(case, "auto")
    return [(whole[seed], run) for seed, run in of_ablation(case, without).items() if seed in whole]


def _compared(pairs: list[tuple[Result, Result]]) -> list[str]:
    """Return in how many campaigns nothing differs, and in how many `auto` needs fewer and more executions."""
    same = sum(whole["distances"] == run["distances"] for whole, run in pairs)
    cells = []
    for percent in ENDS_OF:
        counts = [(first_within(whole, percent), first_within(run, percent)) for whole, run in pairs]
        cells.append(f"{sum(a < b for a, b in counts)} / {sum(a > b for a, b in counts)}")
    return [str(len(pairs)), str(same), *cells]


def average_share(result: Result) -> float:
    """Return the mean over all executions of the budget of the largest distance so far, as a share of d*."""
    shares = np.maximum.accumulate([distance or 0.0 for distance in result["distances"]]) / result["truth"]
    return float(np.pad(np.minimum(shares, 1.0), (0, result["budget"] - len(shares)), mode="edge").mean())
