"""Maximising a function without gradients over the unit cube where its maximum may be rare, in few and large batches.

Large values may fill less than a thousandth of the cube, beside wide maxima that are lower. The search samples the cube
and its faces. Then points evolve in niches: the parents of a generation are the best points that are apart from each
other, so no maximum takes all evaluations. The distance between parents and the steps of their offspring shrink. The
last evaluations refine the best points.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows
from ctxval._util.boxes import separated_rows
from ctxval.gp.ascent import Evaluations, Values


@dataclass(frozen=True)
class GlobalSearchSettings:
    """The parts of a global search, which end after shares of its evaluations, and how far apart niches are."""

    sampled: float = 0.35
    evolved: float = 0.7
    climbed: float = 0.88
    # least distance of good parents at first and at last, and of local maxima, in diagonals
    reaches: tuple[float, float] = (0.3, 0.1)
    # largest standard deviation of a mutation in the first and in the last generation
    steps: tuple[float, float] = (0.3, 0.005)


@dataclass(frozen=True, eq=False)
class GlobalMaximum:
    """What a search of a function over the unit cube has found."""

    points: Array  # all points that were evaluated, those of largest values first (m, d)
    values: Array  # their values (m,); minus infinity if the function was not finite there
    local_maxima: Array  # good points that are apart from each other, the best first (e, d); none if no value is finite


def search_globally(
    function: Values, dimension: int, starts: Array, rng: np.random.Generator, *, evaluations: int = 9000,
    settings: GlobalSearchSettings = GlobalSearchSettings(),
) -> GlobalMaximum:  # fmt: skip
    """Search the unit cube for the maximum of a function, and return everything that was evaluated, of so many points.

    Values that are not finite are never a maximum. Starts ``(s, d)`` are evaluated first, moved into the cube.
    """
    done = Evaluations(function, np.zeros(dimension), np.ones(dimension), evaluations)
    done.evaluate(np.clip(starts, 0, 1))
    for count in _batches(int(settings.sampled * evaluations) - (evaluations - done.left), evaluations, 3):
        done.evaluate(done.samples(count, rng))
    _evolve(done, rng, settings)
    budget = done.left - int((1 - settings.climbed) * evaluations)
    climbs = min(12, budget // (8 * (dimension + 1)))  # each with 8 slopes at least
    if climbs > 0:
        done.climb(_apart(done.finite(), 0.2)[:climbs], budget)
    # Moves to bounds, and ever smaller random moves around the best points.
    if not len(done.finite()):
        done.evaluate(done.samples(done.left, rng))
    else:
        sizes = _batches(done.left, evaluations, 12)
        for batch, size in enumerate(sizes):
            done.move_to_bounds(rng)
            best = done.best_first()[0][:100]
            near = best[np.argsort(np.linalg.norm(best - best[0], axis=1), kind="stable")[: 2 * dimension + 2]]
            step = 0.02 * (1e-5 / 0.02) ** (batch / max(1, len(sizes) - 1))
            done.evaluate(_offspring(best[:4], near, step, min(size, done.left), rng, settings))
    return GlobalMaximum(*done.best_first(), _apart(done.finite(), settings.reaches[-1]))


def _batches(count: int, evaluations: int, most: int) -> list[int]:
    """Return the sizes of at least so many batches of ``count`` points, none larger than a tenth of all evaluations."""
    if count <= 0:
        return []
    batches = max(min(most, count), -(-count // max(1, evaluations // 10)))
    edges = np.linspace(0, count, batches + 1).astype(int)
    return [int(after - before) for before, after in pairwise(edges) if after > before]


def _apart(points: Array, reach: float) -> Array:
    """Return the first of the points ``(m, d)`` that are farther from each other than this share of the diagonal."""
    return points[separated_rows(points, reach * float(np.sqrt(points.shape[1])), 30)]


# Evolution


def _evolve(done: Evaluations, rng: np.random.Generator, settings: GlobalSearchSettings) -> None:
    """Evaluate generations of offspring of good points and of prominent points, each set apart from each other."""
    count = done.left - int((1 - settings.evolved) * done.budget)
    sizes = _batches(count, done.budget, int(np.clip(np.sqrt(done.budget) / 4, 3, 40)))
    # Of smooth functions, prominences are small once the samples are dense; the way to a cliff stays prominent.
    prominent, seen = np.empty(0, dtype=np.intp), 0
    for generation, size in enumerate(sizes):
        share = generation / max(1, len(sizes) - 1)
        finite = done.finite()
        if not len(finite):
            done.evaluate(done.samples(size, rng))
            continue
        reach, step = (first * (last / first) ** share for first, last in (settings.reaches, settings.steps))
        everywhere, heights = done.in_order()
        rows, seen = np.concatenate([prominent, np.arange(seen, len(everywhere))]), len(everywhere)
        prominent = rows[np.argsort(-_prominences(everywhere, heights, rows), kind="stable")[:200]]
        first = _offspring(_apart(finite, reach), finite[:100], step, size - size // 2, rng, settings)
        second = _offspring(_apart(everywhere[prominent], 0.02), finite[:100], step, size // 2, rng, settings)
        done.evaluate(np.concatenate([first, second]))


def _prominences(points: Array, heights: Array, rows: Rows) -> Array:
    """Return by how much some rows exceed a local linear fit, without themselves, to their neighbours."""
    # The scale is linear near the median of the heights and logarithmic far from it; failures are lowest.
    finite = heights[np.isfinite(heights)]
    low, middle, high = np.quantile(finite, [0.25, 0.5, 0.75])
    spread = (high - low) or float(finite.std()) or 1.0
    values = np.arcsinh((np.maximum(heights, finite.min()) - middle) / spread)
    d = points.shape[1]
    count = min(3 * d + 4, len(points))
    distances, neighbours = scipy.spatial.KDTree(points).query(points[rows], count)
    distances, neighbours = distances.reshape(len(rows), -1)[:, 1:], neighbours.reshape(len(rows), -1)[:, 1:]
    offsets = (points[neighbours] - points[rows][:, None]) / np.maximum(distances[:, -1:, None], 1e-12)
    terms = np.concatenate([np.ones((*offsets.shape[:2], 1)), offsets], axis=2)
    normal = np.swapaxes(terms, 1, 2) @ terms + 1e-3 * np.eye(d + 1)
    fitted = np.linalg.solve(normal, np.swapaxes(terms, 1, 2) @ values[neighbours][..., None])
    return np.asarray(values[rows] - fitted[:, 0, 0])


def _offspring(
    parents: Array, pool: Array, step: float, count: int, rng: np.random.Generator, settings: GlobalSearchSettings
) -> Array:
    """Return ``count`` points: mutations in all or a few coordinates, differential moves, and moves to bounds."""
    # Half of the parents are drawn uniformly, so that each niche is followed; half prefer good ones.
    preferences = 1 / np.arange(1, len(parents) + 1)
    uniform = rng.integers(len(parents), size=count)
    good = rng.choice(len(parents), size=count, p=preferences / preferences.sum())
    chosen = parents[np.where(rng.random(count) < 0.5, uniform, good)]
    all_of, few_of, differential, bound = np.array_split(chosen, 4)
    children = [
        all_of + _normal(all_of.shape, step, rng),
        few_of + _normal(few_of.shape, max(step, settings.steps[0] / 3), rng) * _few(few_of.shape, rng),
    ]
    # Shares of differences between two points of the pool, in a random part of the coordinates.
    first, second = rng.integers(len(pool), size=(2, len(differential)))
    factors = rng.uniform(0.2, 1.0, size=(len(differential), 1))
    children.append(differential + factors * (pool[first] - pool[second]) * (rng.random(differential.shape) < 0.7))
    moved = bound + _normal(bound.shape, step, rng) * _few(bound.shape, rng)
    children.append(np.where(_few(bound.shape, rng) > 0, rng.integers(2, size=bound.shape), moved))
    return np.clip(np.concatenate(children), 0, 1)


def _normal(shape: tuple[int, ...], step: float, rng: np.random.Generator) -> Array:
    """Return normal moves; the logarithm of each move's standard deviation is uniform up to that of the step."""
    steps = step * 0.03 ** rng.random((shape[0], 1))
    return np.asarray(steps * rng.normal(size=shape))


def _few(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return 1 for one coordinate of each row and, by chance, for one or two more; 0 for the others."""
    chosen = rng.random(shape) < 1 / shape[1]
    chosen[np.arange(shape[0]), rng.integers(shape[1], size=shape[0])] = True
    return chosen.astype(np.float64)
