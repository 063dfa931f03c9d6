"""The largest distance d* of each entry and seed, found by a deep search of the true system and kept in a file.

A line of ``results/dynamics_truths.jsonl`` belongs to an entry, a seed and a digest of the source of the system, so
that a truth of another version of it is never used. ``python benchmarks/dynamics_truths.py`` computes what is missing.

For a system with noise, d* is the largest mean distance over ``REALISATIONS`` realisations of the noise, and the line
also has the 0.95 quantile of the distance at that task.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctxval import Experiment, Validation
from ctxval._util.arrays import Array
from ctxval._util.boxes import climb, separated_rows
from ctxval._util.code_digest import source_digest
from dynamics_development import DEVELOPMENT
from dynamics_reporting import REPORTING
from dynamics_rough import ROUGH
from dynamics_systems import Entry, realisations
from json_lines import JsonLines
from study_auto import RESULTS

TRUTHS = JsonLines(RESULTS / "dynamics_truths.jsonl", ("entry", "seed", "digest"))
ENTRIES = {**DEVELOPMENT, **REPORTING, **ROUGH}
REALISATIONS = 8
AGREEMENT, LEAST, MOST = 2e-3, 3, 8
"""Relative difference of the repeats that ends the search, and the fewest and the most repeats."""
SAMPLES, NICHES, GENERATIONS = 66000, 20, 20
STEP = 1e-6
"""Of central differences, in widths of the unit cube."""


@dataclass
class DeepSearch:
    """A search for the maximum over the unit cube, whole batches at once.

    Attributes:
        values: function of points ``(N, d)``, which returns shape ``(N,)``, minus infinity where an execution fails.
        dimension: d.
        samples: how many random points each repeat begins with; half of them have coordinates on faces of the cube.
        evaluations: the points so far.
    """

    values: Callable[[Array], Array]
    dimension: int
    samples: int = SAMPLES
    evaluations: int = field(default=0, init=False)

    def repeat(self, seed: int) -> tuple[float, Array]:
        """Return the largest value that one search finds, and its point ``(d,)``."""
        rng = np.random.default_rng([seed, self.dimension])
        points, values = self._sampled(rng)
        points, values = self._evolved(points, values, rng)
        order = np.argsort(-values)
        points, values = points[order], values[order]
        chosen = separated_rows(points, 0.02, 6)
        points, values = self._polished(points[chosen], values[chosen], rng)
        return float(values.max()), points[np.argmax(values)]

    def _counted(self, points: Array) -> Array:
        self.evaluations += len(points)
        return self.values(points)

    def _sampled(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return the best points, no two of which are neighbours, with their values."""
        points = rng.random((self.samples, self.dimension))
        snapped = points[: self.samples // 2]
        on_face = rng.random(snapped.shape) < rng.uniform(0.1, 1.0, (len(snapped), 1))
        snapped[on_face] = np.round(snapped[on_face])
        values = self._counted(points)
        order = np.argsort(-values)[:200]
        rows = order[separated_rows(points[order], 0.1 * np.sqrt(self.dimension), NICHES)]
        return points[rows], values[rows]

    def _evolved(self, points: Array, values: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return the best point of each niche after an evolution with a covariance matrix for each niche."""
        niches, d = points.shape
        offspring = 12 + 3 * d
        centres, best, tops = points.copy(), points.copy(), values.copy()
        covariance = np.tile(0.1**2 * np.eye(d), (niches, 1, 1))
        for _ in range(GENERATIONS):
            moves = np.linalg.cholesky(covariance + 1e-12 * np.eye(d)) @ rng.normal(size=(niches, d, offspring))
            born = np.clip(centres[:, None, :] + np.swapaxes(moves, 1, 2), 0, 1)
            found = self._counted(born.reshape(-1, d)).reshape(niches, offspring)
            order = np.argsort(-found, axis=1)[:, : offspring // 4]
            elite = np.take_along_axis(born, order[..., None], axis=1)
            away = elite - centres[:, None, :]
            covariance = 0.5 * covariance + 0.5 * np.swapaxes(away, 1, 2) @ away / elite.shape[1]
            centres = elite.mean(axis=1)
            better = found.max(axis=1) > tops
            tops, best = np.where(better, found.max(axis=1), tops), np.where(better[:, None], elite[:, 0], best)
        return best, tops

    def _polished(self, points: Array, values: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Climb by gradients, then by random steps that shrink, which need no gradient."""
        top = float(np.abs(values).max()) or 1.0
        low, high = np.zeros(self.dimension), np.ones(self.dimension)
        with np.errstate(all="ignore"):
            climbed, _ = climb(lambda x: self._sloped(x, top), points, low, high, iterations=40, evaluations=80)
        points, values = self._better(points, values, climbed)
        for size in np.geomspace(0.03, 1e-5, 20):
            mask = rng.random((len(points), 24, self.dimension)) < rng.uniform(0.2, 1.0, (len(points), 24, 1))
            tried = np.clip(points[:, None] + size * mask * rng.normal(size=mask.shape), 0, 1)
            found = self._counted(tried.reshape(-1, self.dimension)).reshape(len(points), -1)
            better = found.max(axis=1) > values
            best = np.take_along_axis(tried, found.argmax(axis=1)[:, None, None], axis=1)[:, 0]
            points, values = np.where(better[:, None], best, points), np.where(better, found.max(axis=1), values)
        return points, values

    def _better(self, points: Array, values: Array, others: Array) -> tuple[Array, Array]:
        found = self._counted(others)
        better = found > values
        return np.where(better[:, None], others, points), np.where(better, found, values)

    def _sloped(self, points: Array, scale: float) -> tuple[Array, Array]:
        """Return values ``(N,)`` and central differences ``(N, d)``, both over the scale."""
        moves = STEP * np.eye(self.dimension)
        up, down = np.clip(points[:, None] + moves, 0, 1), np.clip(points[:, None] - moves, 0, 1)
        stacked = np.concatenate([points[:, None], up, down], axis=1)
        found = self._counted(stacked.reshape(-1, self.dimension)).reshape(len(points), -1) / scale
        widths = np.diagonal(up, axis1=1, axis2=2) - np.diagonal(down, axis1=1, axis2=2)
        slopes = (found[:, 1 : self.dimension + 1] - found[:, self.dimension + 1 :]) / widths
        return np.nan_to_num(found[:, 0], neginf=-1.0), np.where(np.isfinite(slopes), slopes, 0.0)


def search(found: Experiment, samples: int = SAMPLES) -> dict[str, Any]:
    """Return the record of a truth.

    Args:
        found: the experiment.
        samples: how many random tasks each repeat begins with, for all realisations of the noise together.
    """
    validation, started = found.validation, time.process_time()
    noisy = realisations(validation, REALISATIONS)

    def values(unit_points: Array) -> Array:
        points = validation.space.from_unit(unit_points)
        mean = np.mean([one.distances(points) for one in noisy], axis=0)
        return np.where(np.isfinite(mean), mean, -np.inf)

    deep = DeepSearch(values, validation.space.dimension, samples // len(noisy))
    tops: list[tuple[float, Array]] = []
    while len(tops) < LEAST or (difference(tops) > AGREEMENT and len(tops) < MOST):
        tops.append(deep.repeat(len(tops)))
    point = max(tops, key=lambda top: top[0])[1]
    record = {
        # A closed loop that diverges amplifies the rounding of a batch, so the task executed alone counts.
        "distance": float(values(point[None])[0]),
        "point": validation.space.from_unit(point).tolist(),
        "repeats": [top for top, _ in tops],
        "evaluations": deep.evaluations * len(noisy),
        "median": _median(validation),
        "seconds": round(time.process_time() - started, 2),
    }
    return {**record, **({"quantile": _quantile(validation, point)} if len(noisy) > 1 else {})}


def difference(tops: list[tuple[float, Array]]) -> float:
    """Return the relative difference of the best and the third-best value."""
    values = sorted((value for value, _ in tops), reverse=True)
    return (values[0] - values[LEAST - 1]) / values[0]


def _median(validation: Validation) -> float:
    return float(np.nanmedian(validation.distances(validation.space.iid(2000, np.random.default_rng(0)))))


def _quantile(validation: Validation, point: Array) -> float:
    rows = validation.space.from_unit(point)[None]
    return float(np.quantile([one.distances(rows)[0] for one in realisations(validation, 200)], 0.95))


def digest(make: Callable[[int], Experiment]) -> str:
    """Return a digest of the source of what makes the experiment of a seed."""
    found = source_digest(make)
    if found is None:
        raise ValueError(f"{make!r} has no source of its own")
    return found


def belongs(record: dict[str, Any], found: Experiment) -> bool:
    """Return whether the task of a record has its distance here.

    Learning a model amplifies the rounding of a processor. A few entries have another M, and another d*, elsewhere.
    """
    noisy = realisations(found.validation, REALISATIONS)
    value = np.mean([one.distances(np.array([record["point"]]))[0] for one in noisy])
    return bool(np.isclose(value, record["distance"], rtol=1e-6))


def truth(entry: Entry, seed: int, file: JsonLines = TRUTHS) -> dict[str, Any]:
    """Return the record of an entry and a seed, computing and storing it if it is missing; ``distance`` is d*."""
    return known(file, (entry.name, seed, digest(entry.make)), entry(seed), SAMPLES)


def known(file: JsonLines, key: tuple[str, int, str], found: Experiment, samples: int) -> dict[str, Any]:
    """Return the record of a key, computing and storing it if there is none or it does not belong to the experiment."""
    if key not in file or not belongs(file[key], found):
        file.append({**dict(zip(file.key, key, strict=True)), **search(found, samples)})
    return file[key]


def row(entry: Entry, records: list[dict[str, Any]]) -> str:
    """Return the row of a table."""
    dimension, pairs, horizon = entry.dimensions()
    ratios = [record["distance"] / record["median"] for record in records]
    spread = max(difference([(value, np.empty(0)) for value in record["repeats"]]) for record in records)
    cells = [
        entry.name, entry.family, dimension, pairs, horizon, len(records), f"{min(ratios):.1f} to {max(ratios):.1f}",
        f"{spread:.2%}", f"{np.mean([record['evaluations'] for record in records]):,.0f}",
        f"{np.mean([record['seconds'] for record in records]):.1f}",
    ]  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


HEADS = ("entry", "family", "tasks", "n + m", "H", "seeds", "d* / median", "largest spread", "evaluations", "CPU s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(ENTRIES))
    parser.add_argument("--seeds", type=int, default=10, help="at most; costly entries have fewer")
    options = parser.parse_args()
    for seed in range(options.seeds):
        for name in options.names:
            if seed < ENTRIES[name].seeds:
                truth(ENTRIES[name], seed)
    print("| " + " | ".join(HEADS) + " |")
    print("|---" * len(HEADS) + "|")
    for name in options.names:
        entry = ENTRIES[name]
        print(row(entry, [truth(entry, seed) for seed in range(min(options.seeds, entry.seeds))]))


if __name__ == "__main__":
    main()
