"""The part of ``docs/searches.md`` on plants of the falsification literature and of robotics. Nothing is run here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from page_tables import Table, table
from plants import PLANTS, Plant
from plants.truths import TRUTHS
from study_auto import Result, first_within, shown
from study_plants import SEARCHES, SEEDS, STORED, UNCHANGED, VERSIONS, version_of

PERCENTS = (5.0, 1.0)

TEXT = """## Plants from the falsification literature and from robotics

These [plants](../benchmarks/plants/__init__.py) were written down before any search had run on them; most are ported
from the published equations of the ARCH competition. A `development` plant may be used to develop `auto`, a
`reporting` plant not. M is learned from recorded data of the plant, new for each of {seeds} seeds. The table has
medians of the executions to 5 % and 1 % of d*, and the best distance found as a median share of d* (least). `scalar`
uses the distances alone.

{short}

d* is the largest value of three to eight deep searches. On `cart-pole` and `six-joint-arm` these disagree by
{spread}, so d* is the best value known. Tables: [the plants](tables/searches-plants.csv), [each seed of
`auto`](tables/searches-plants-auto.csv), [other searches](tables/searches-plants-others.csv)."""


def part() -> tuple[str, dict[str, Table]]:
    """Return the part of the page and its tables."""
    plants = plants_rows()
    spreads = {row[0]: row[-1] for row in plants}
    text = TEXT.format(
        seeds=SEEDS,
        short=table(["plant", "kind", "tasks", "auto: 5 %", "1 %", "best", "scalar: 5 %", "1 %", "best"], short_rows()),
        spread=f"{spreads['cart-pole']} and {spreads['six-joint-arm']}",
    )
    return text, {
        "searches-plants": (["plant", "kind", "tasks", "budget", "seeds with d*", "d* / median", "spread"], plants),
        "searches-plants-auto": auto_table(),
        "searches-plants-others": others_table(),
    }


def short_rows() -> list[list[str]]:
    """Return medians of `auto`, with the code of today, and of `scalar`."""
    rows = []
    for plant in PLANTS.values():
        row = [plant.name, plant.kind, f"{plant.dimension}-D"]
        for search, version in (("auto", "after"), ("scalar", UNCHANGED)):
            found = campaigns(plant, search, version)
            row += [executions(found, percent, plant.budget).split(" (")[0] for percent in PERCENTS]
            row.append(best_found(found.values()))
        rows.append(row)
    return rows


def truths_of(plant: Plant) -> list[dict[str, Any]]:
    """Return the stored maxima of a plant, one for each seed."""
    return list({record["seed"]: record for record in TRUTHS.select(plant=plant.name)}.values())


def plants_rows() -> list[list[str]]:
    """Return what the plants are, with their maxima and how far deep searches of them disagree."""
    rows = []
    for plant in PLANTS.values():
        records = truths_of(plant)
        ratios = [record["distance"] / record["median"] for record in records]
        rows.append([
            plant.name, plant.kind, f"{plant.dimension}-D", str(plant.budget), str(len(records)),
            f"{min(ratios):.1f} to {max(ratios):.1f}" if ratios else "-",
            f"{max(spread(record['repeats']) for record in records):.1%}" if records else "-",
        ])  # fmt: skip
    return rows


def spread(repeats: list[float]) -> float:
    """Return the relative difference of the best and the third-best repeat of a deep search."""
    best = sorted(repeats, reverse=True)
    return (best[0] - best[2]) / best[0]


def campaigns(plant: Plant, search: str, version: str) -> dict[int, Result]:
    """Return the stored campaigns of a search on a plant, by their seeds."""
    keys = {seed: (plant.name, seed, search, version_of(search, version)) for seed in range(SEEDS)}
    return {seed: STORED[key] for seed, key in keys.items() if key in STORED}


def executions(found: dict[int, Result], percent: float, budget: int) -> str:
    """Return the median of the executions, and those of each seed."""
    counts = {seed: first_within(result, percent) for seed, result in found.items()}
    if not counts:
        return "-"
    each = ", ".join(shown(counts[seed], budget) if seed in counts else "-" for seed in range(SEEDS))
    return f"{shown(float(np.median(list(counts.values()))), budget)} ({each})"


def best_found(found: Iterable[Result]) -> str:
    """Return the median and the smallest share of d* that campaigns end with."""
    shares = [100 * max(d or 0.0 for d in result["distances"]) / result["truth"] for result in found]
    return f"{np.median(shares):.1f} % ({min(shares):.1f})" if shares else "-"


def versions_run() -> list[str]:
    """Return the versions of `auto` that have campaigns."""
    return [version for version in VERSIONS if STORED.select(search="auto", version=version)]


def auto_table() -> tuple[list[str], list[list[Any]]]:
    """Return the head and the rows of the executions of `auto`, before and after if there are both."""
    versions = versions_run()
    head = [f"{percent:g} %, {version}" for percent in PERCENTS for version in versions]
    rows = []
    for plant in PLANTS.values():
        found = {version: campaigns(plant, "auto", version) for version in versions}
        counts = [executions(found[version], percent, plant.budget) for percent in PERCENTS for version in versions]
        ends = [best_found(found[version].values()) for version in versions]
        rows.append([plant.name, plant.kind, *counts, *ends])
    return ["plant", "kind", *head, *(f"best found, {version}: median (least)" for version in versions)], rows


def others_table() -> tuple[list[str], list[list[Any]]]:
    """Return the head and the rows of the executions of the other searches."""
    rows = []
    for plant in PLANTS.values():
        for search in (search for search in SEARCHES if search != "auto"):
            found = campaigns(plant, search, UNCHANGED)
            counts = [executions(found, percent, plant.budget) for percent in PERCENTS]
            rows.append([plant.name, plant.kind, search, *counts, best_found(found.values())])
    return ["plant", "kind", "search", *(f"{percent:g} %" for percent in PERCENTS), "best found: median (least)"], rows
