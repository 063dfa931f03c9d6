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

from ctxval._util.arrays import Array, Rows
from ctxval._util.boxes import separated_rows
from ctxval._util.representation import call
from ctxval.gp.evaluations import Evaluations, Values

_SAMPLED, _EVOLVED = 0.3, 0.75
"""Shares of the evaluations after which sampling and evolution end."""
_GENERATIONS = 40
"""Largest number of generations of the evolution."""
_REFINEMENTS = 12
"""Largest number of batches of the refinement."""
_ELITES = 30
"""Number of parents of a generation, and of elites that are returned."""
_REACHES = (0.3, 0.02)
"""Least distance of the parents in the first and in the last generation, as a share of the cube's diagonal."""
_STEPS = (0.3, 0.005)
"""Largest standard deviation of a mutation in the first and in the last generation."""
_SPREAD = 0.03
"""Smallest standard deviation of a mutation, as a share of the largest one."""
_POOL = 100
"""Number of best points of whose differences moves are made."""
_CLIMBED = 4
"""Number of points from which the refinement climbs."""
_REFINED = (0.02, 1e-5)
"""Standard deviations of the moves in the first and in the last batch of the refinement."""


@dataclass(frozen=True, eq=False)
class GlobalMaximum:
    """What a search of a function over the unit cube has found.

    Attributes:
        points: all points that were evaluated, those of largest values first, shape ``(m, d)``.
        values: their values, shape ``(m,)``; minus infinity if the function was not finite there.
        elites: good points that are apart from each other, the best first, shape ``(e, d)``; none if no value is
            finite.
        evaluations: number of points at which the function was evaluated.
    """

    points: Array
    values: Array
    elites: Array
    evaluations: int

    def __repr__(self) -> str:
        largest = float(self.values[0]) if len(self.values) else None
        return call(self, largest=largest, elites=len(self.elites), evaluations=self.evaluations)


def search_globally(
    function: Values, dimension: int, starts: Array, rng: np.random.Generator, *, evaluations: int = 9000
) -> GlobalMaximum:
    """Search the unit cube for the maximum of a function, and return everything that was evaluated.

    Args:
        function: points ``(m, d)`` of the cube -> values ``(m,)``; values that are not finite are never a maximum.
        dimension: the number d of coordinates.
        starts: points ``(s, d)`` to evaluate first; points outside of the cube are moved to its faces.
        rng: the source of all random numbers.
        evaluations: number of points at which the function may be evaluated.
    """
    done = Evaluations(function, np.zeros(dimension), np.ones(dimension), evaluations)
    done.evaluate(np.clip(starts, 0, 1))
    for count in _batches(int(_SAMPLED * evaluations) - (evaluations - done.left), evaluations, 3):
        done.evaluate(done.samples(count, rng))
    _evolve(done, rng)
    _refine(done, rng)
    points, values = done.found()
    return GlobalMaximum(points, values, _apart(points[np.isfinite(values)], _REACHES[-1]), len(values))


def _batches(count: int, evaluations: int, most: int) -> list[int]:
    """Return the sizes of at least so many batches of ``count`` points, none larger than a tenth of all evaluations."""
    if count <= 0:
        return []
    batches = max(min(most, count), -(-count // max(1, evaluations // 10)))
    edges = np.linspace(0, count, batches + 1).astype(int)
    return [int(after - before) for before, after in pairwise(edges) if after > before]


def _apart(points: Array, reach: float) -> Array:
    """Return the first of the points ``(m, d)`` that are farther from each other than this share of the diagonal."""
    return points[separated_rows(points, reach * float(np.sqrt(points.shape[1])), _ELITES)]


def _geometric(ends: tuple[float, float], share: float) -> float:
    return float(ends[0] * (ends[1] / ends[0]) ** share)


# Evolution


def _evolve(done: Evaluations, rng: np.random.Generator) -> None:
    """Evaluate generations of offspring of the best points that are apart from each other."""
    count = done.left - int((1 - _EVOLVED) * done.budget)
    sizes = _batches(count, done.budget, int(np.clip(np.sqrt(done.budget) / 4, 3, _GENERATIONS)))
    for generation, size in enumerate(sizes):
        share = generation / max(1, len(sizes) - 1)
        points, values = done.found()
        finite = points[np.isfinite(values)]
        if not len(finite):
            done.evaluate(done.samples(size, rng))
            continue
        parents = _apart(finite, _geometric(_REACHES, share))
        done.evaluate(_offspring(parents, finite[:_POOL], _geometric(_STEPS, share), size, rng))


def _offspring(parents: Array, pool: Array, step: float, count: int, rng: np.random.Generator) -> Array:
    """Return ``count`` points: mutations in all or a few coordinates, differential moves, and moves to bounds."""
    chosen = parents[_drawn(len(parents), count, rng)]
    all_of, few_of, differential, bound = np.array_split(chosen, 4)
    children = [
        all_of + _normal(all_of.shape, step, rng),
        few_of + _normal(few_of.shape, max(step, _STEPS[0] / 3), rng) * _few(few_of.shape, rng),
        differential + _differences(pool, differential.shape, rng),
        _to_bounds(bound + _normal(bound.shape, step, rng) * _few(bound.shape, rng), rng),
    ]
    return np.clip(np.concatenate(children), 0, 1)


def _drawn(parents: int, count: int, rng: np.random.Generator) -> Rows:
    """Return rows of parents: half of them uniform, so that each niche is followed, half prefer good ones."""
    rank_weights = 1 / np.arange(1, parents + 1)
    uniform = rng.integers(parents, size=count)
    good = rng.choice(parents, size=count, p=rank_weights / rank_weights.sum())
    return np.where(rng.random(count) < 0.5, uniform, good)


def _normal(shape: tuple[int, ...], step: float, rng: np.random.Generator) -> Array:
    """Return normal moves; the logarithm of each move's standard deviation is uniform up to that of the step."""
    steps = step * _SPREAD ** rng.random((shape[0], 1))
    return np.asarray(steps * rng.normal(size=shape))


def _few(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return 1 for one coordinate of each row and, by chance, for one or two more; 0 for the others."""
    chosen = rng.random(shape) < 1 / shape[1]
    chosen[np.arange(shape[0]), rng.integers(shape[1], size=shape[0])] = True
    return chosen.astype(np.float64)


def _differences(pool: Array, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return shares of differences between two points of a pool, in a random part of the coordinates."""
    first, second = rng.integers(len(pool), size=(2, shape[0]))
    factor = rng.uniform(0.2, 1.0, size=(shape[0], 1))
    return np.asarray(factor * (pool[first] - pool[second]) * (rng.random(shape) < 0.7))


def _to_bounds(points: Array, rng: np.random.Generator) -> Array:
    """Return the points with a coordinate or more moved to bounds."""
    return np.where(_few(points.shape, rng) > 0, rng.integers(2, size=points.shape), points)


# Refinement


def _refine(done: Evaluations, rng: np.random.Generator) -> None:
    """Climb from the best points along slopes, then try moves to bounds and ever smaller random moves around them."""
    points, values = done.found()
    finite = points[np.isfinite(values)]
    if not len(finite):
        done.evaluate(done.samples(done.left, rng))
        return
    if done.left > 4 * (done.dimension + 1):
        done.climb(_apart(finite, _REACHES[-1])[:_CLIMBED], done.left // 2)
    sizes = _batches(done.left, done.budget, _REFINEMENTS)
    for batch, size in enumerate(sizes):
        done.move_to_bounds(rng)
        best = done.found()[0][:_POOL]
        near = best[np.argsort(np.linalg.norm(best - best[0], axis=1), kind="stable")[: 2 * done.dimension + 2]]
        step = _geometric(_REFINED, batch / max(1, len(sizes) - 1))
        done.evaluate(_offspring(best[:_CLIMBED], near, step, min(size, done.left), rng))
