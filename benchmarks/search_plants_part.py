"""The part of ``docs/searches.md`` on plants of the falsification literature and of robotics. Nothing is run here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from page_tables import table
from plants import PLANTS, Plant
from plants.truths import TRUTHS
from study_auto import Result, first_within, shown
from study_plants import SEARCHES, SEEDS, STORED, UNCHANGED, VERSIONS, version_of

PERCENTS = (5.0, 1.0)

TEXT = """## Plants from the falsification literature and from robotics

These [plants](../benchmarks/plants/__init__.py) were written down before any search had run on them. Most are ported
from benchmarks of the ARCH competition, from their published equations, and each module states its source and what
differs from it. A `development` plant may be used to develop `auto`. Nothing may be chosen by a `reporting` plant. M is
learned from recorded data of the plant, with new data for each seed.

{plants}

d* is the largest value of three to eight deep searches of the true system. `Spread` is the largest relative difference
between the best and the third-best of these searches. If it exceeds 1 %, d* is the best value known, and the executions
to 1 % of it are uncertain.

The next tables give the executions to within 5 % and 1 % of d*: the median, and in parentheses each seed. `> 25` means
that the campaign was not within the percentage after its budget of 25 executions. `-` means that the campaign has not
been run. {versions}

{auto}

The other searches use the distances alone:

{others}

{missing}
"""


def text() -> str:
    """Return the part; without campaigns it is empty."""
    if not len(STORED):
        return ""
    return TEXT.format(
        plants=plants_table(),
        versions=versions_sentence(),
        auto=table(*auto_table()),
        others=table(*others_table()),
        missing=missing_sentence(),
    )


def truths_of(plant: Plant) -> list[dict[str, Any]]:
    """Return the stored maxima of a plant, one for each seed."""
    return list({record["seed"]: record for record in TRUTHS.select(plant=plant.name)}.values())


def plants_table() -> str:
    """Return what the plants are, with their maxima."""
    rows = []
    for plant in PLANTS.values():
        records = truths_of(plant)
        ratios = [record["distance"] / record["median"] for record in records]
        rows.append([
            plant.name, plant.kind, f"{plant.dimension}-D", str(plant.budget), str(len(records)),
            f"{min(ratios):.1f} to {max(ratios):.1f}" if ratios else "-",
            f"{max(spread(record['repeats']) for record in records):.1%}" if records else "-",
        ])  # fmt: skip
    return table(["plant", "kind", "tasks", "budget", "seeds with d*", "d* / median", "spread"], rows)


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


def versions_sentence() -> str:
    """Return which code the versions of `auto` are."""
    named = {"before": "`before` is the code of commit 85e23b1", "after": "`after` is the code of today"}
    return f"Of `auto`, {' and '.join(named[version] for version in versions_run())}." if versions_run() else ""


def missing_sentence() -> str:
    """Return which campaigns have not been run; empty if all have."""
    wanted = [("auto", version) for version in versions_run()]
    wanted += [(search, UNCHANGED) for search in SEARCHES if search != "auto"]
    parts = []
    for search, version in wanted:
        counts = {plant.name: len(campaigns(plant, search, version)) for plant in PLANTS.values()}
        few = [f"{name} {count}" for name, count in counts.items() if count < SEEDS]
        name = search if version == UNCHANGED else f"{search}, {version}"
        parts += [f"- {name}: {', '.join(few)}"] if few else []
    if not parts:
        return ""
    head = f"Plants with fewer than {SEEDS} seeds so far. `make search` runs those of the code of today. Those of"
    return "\n".join([head, "`before` need the code of its commit and the option `--version before`.", "", *parts])
