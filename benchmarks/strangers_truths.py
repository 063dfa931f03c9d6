"""The largest distance d* of each system of strangers, found by a deep search of the true system and kept in a file.

A line of ``results/strangers_truths.jsonl`` belongs to an entry, a seed and a digest of its source, as those of
``dynamics_truths.py``. Beside d* it has the share of tasks that the mechanism touches, the largest distance of the
others if they are many, and the share of tasks above 0.95 d*. ``python benchmarks/strangers_truths.py`` computes what
is missing and prints a table. No certificate is computed.
"""

from __future__ import annotations

import argparse
import inspect
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval import Validation
from ctxval._util.arrays import Array
from dynamics_truths import AGREEMENT, LEAST, DeepSearch, belongs, difference, digest
from json_lines import JsonLines
from strangers import Stranger
from strangers_development import DEVELOPMENT
from strangers_reporting import REPORTING
from study_auto import RESULTS

TRUTHS = JsonLines(RESULTS / "strangers_truths.jsonl", ("entry", "seed", "digest"))
ENTRIES = {**DEVELOPMENT, **REPORTING}
SEEDS = {"development": 2, "reporting": 10}
"""Seeds of each system, of which each is another system."""
SAMPLES, MOST, DRAWS = 24000, 6, 20000
"""Random tasks that each repeat begins with, the most repeats, and random tasks that shares are counted on."""
TOUCHED = 1e-6
"""Relative change of the distance from which a task counts as touched by the mechanism."""
MANY = 0.5
"""Share of untouched tasks from which their largest distance is searched for."""


@dataclass
class HintedSearch(DeepSearch):
    """A search that also begins near points where a narrow effect lives.

    Attributes:
        hints: shape ``(k, d)``; None if there are none.
    """

    hints: Array | None = None

    def _sampled(self, rng: np.random.Generator) -> tuple[Array, Array]:
        points, values = super()._sampled(rng)
        if self.hints is None:
            return points, values
        chosen = self.hints[rng.integers(len(self.hints), size=self.samples // 4)]
        near = np.clip(chosen + 0.02 * rng.normal(size=chosen.shape), 0, 1)
        found = self._counted(near)
        best = np.argsort(-found)[:8]
        return np.concatenate([points, near[best]]), np.concatenate([values, found[best]])


def search(entry: Stranger, seed: int) -> dict[str, Any]:
    """Return the record of a truth."""
    validation, started = entry(seed).validation, time.process_time()
    plain = None if entry.without is None else entry.without(seed).validation
    hints = None if entry.hints is None else validation.space.to_unit(entry.hints(seed))
    deep = HintedSearch(_distances(validation), validation.space.dimension, SAMPLES, hints)
    tops = _repeated(deep, MOST)
    distance, point = max(tops, key=lambda top: top[0])
    points = validation.space.iid(DRAWS, np.random.default_rng(0))
    values = validation.distances(points)
    touched = 1.0 if plain is None else float(_touched(values, plain.distances(points)).mean())
    outside = None
    if plain is not None and touched < 1 - MANY:
        others = DeepSearch(_untouched(validation, plain), validation.space.dimension, SAMPLES // 2)
        outside = max(value for value, _ in _repeated(others, LEAST))
    return {
        # A closed loop that diverges amplifies the rounding of a batch, so the task executed alone counts.
        "distance": float(deep.values(point[None])[0]),
        "point": validation.space.from_unit(point).tolist(),
        "repeats": [top for top, _ in tops],
        "median": float(np.nanmedian(values)),
        "touched": touched,
        "outside": outside,
        "near": float(np.mean(values > 0.95 * distance)),
        "failed": float(np.mean(~np.isfinite(values))),
        "evaluations": deep.evaluations,
        "seconds": round(time.process_time() - started, 2),
    }


def _repeated(deep: DeepSearch, most: int) -> list[tuple[float, Array]]:
    tops: list[tuple[float, Array]] = []
    while len(tops) < LEAST or (len(tops) < most and difference(tops) > AGREEMENT):
        tops.append(deep.repeat(len(tops)))
    return tops


def _distances(validation: Validation) -> Callable[[Array], Array]:
    def values(unit_points: Array) -> Array:
        found = validation.distances(validation.space.from_unit(unit_points))
        return np.where(np.isfinite(found), found, -np.inf)

    return values


def _untouched(validation: Validation, plain: Validation) -> Callable[[Array], Array]:
    inside, outside = _distances(validation), _distances(plain)

    def values(unit_points: Array) -> Array:
        found = inside(unit_points)
        return np.where(_touched(found, outside(unit_points)), -np.inf, found)

    return values


def _touched(values: Array, plain: Array) -> Array:
    return ~np.isclose(values, plain, rtol=TOUCHED, atol=1e-9)


def truth(entry: Stranger, seed: int, file: JsonLines = TRUTHS) -> dict[str, Any]:
    """Return the record of an entry and a seed, computing and storing it if it is missing; ``distance`` is d*."""
    key = (entry.name, seed, digest(entry.make))
    if key not in file or not belongs(file[key], entry(seed)):
        file.append({**dict(zip(file.key, key, strict=True)), **search(entry, seed)})
    return file[key]


def states_and_inputs(entry: Stranger) -> tuple[int, int]:
    """Return the numbers of recorded states and of inputs."""
    validation = entry(0).validation
    found = validation.plan(0.5 * (validation.space.low + validation.space.high)).model_trajectory
    return found.states.shape[-1], found.inputs.shape[-1]


def row(entry: Stranger, records: list[dict[str, Any]]) -> str:
    """Return the row of a table; of the first seed, but for the largest spread."""
    first, (n, m) = records[0], states_and_inputs(entry)
    tasks, _, horizon = entry.dimensions()
    told = (inspect.getdoc(entry.make) or "").partition("\n")[0].removeprefix("Return ")
    cells = [
        entry.name, entry.family, "no" if entry.misleading else "yes", n, m, tasks, horizon,
        f"{first['distance']:.3g}", f"{first['distance'] / first['median']:.1f}",
        "-" if first["outside"] is None else f"{first['distance'] / first['outside']:.2f}",
        f"{first['touched']:.2%}", f"{first['near']:.2%}",
        f"{max(difference([(value, np.empty(0)) for value in record['repeats']]) for record in records):.2%}", told,
    ]  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


HEADS = (
    *("entry", "family", "regular", "states", "inputs", "tasks", "H", "d*", "d* / median", "d* / outside"),
    *("touched", "above 0.95 d*", "spread", "what M misses"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(ENTRIES))
    parser.add_argument("--seeds", type=int, help=f"{SEEDS} if it is not given")
    options = parser.parse_args()
    print("| " + " | ".join(HEADS) + " |")
    print("|---" * len(HEADS) + "|")
    for name in options.names:
        entry = ENTRIES[name]
        seeds = options.seeds or SEEDS["reporting" if name in REPORTING else "development"]
        print(row(entry, [truth(entry, seed) for seed in range(seeds)]), flush=True)


if __name__ == "__main__":
    main()
