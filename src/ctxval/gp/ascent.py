"""Maximising a function without gradients over a box, in few and large batches.

Many of these maxima lie at corners of the box, so corners are sampled more densely. The search is local: it ends at the
maxima whose slopes the first samples have met. :mod:`ctxval.gp.global_search` looks for maxima that are rare.
"""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.boxes import separated_rows
from ctxval.gp.evaluations import Evaluations, Values

_STARTS = 6
"""Number of points from which the function is climbed."""
_SEPARATION = 0.1
"""Least distance between the starts, as a share of the box's diagonal."""
_FEW = 3
"""Largest dimension in which samples ever closer to the best points replace the climbs."""
_ZOOMS = (0.03, 0.01, 0.003, 0.001)
"""Standard deviations of these samples, as shares of the box."""


class Ascent:
    """One search for the maximum of a function over a box within the unit cube.

    The function is sampled. Quasi-Newton climbs start from the best samples, all at once. Then coordinates are moved to
    the box's bounds.

    Args:
        function: points ``(m, d)`` -> values ``(m,)``; values that are not finite are never a maximum.
        low, high: the bounds of the box, shapes ``(d,)``.
        budget: number of points at which the function may be evaluated; the last climb may exceed it.
    """

    def __init__(self, function: Values, low: Array, high: Array, budget: int) -> None:
        self._evaluations = Evaluations(function, low, high, budget, strict=False)

    def run(self, starts: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return points ``(m, d)`` and values ``(m,)`` that were evaluated, the largest first.

        Args:
            starts: points ``(s, d)`` to evaluate first.
            rng: the source of the samples.
        """
        done = self._evaluations
        sampled = max(8, done.budget // 3)
        done.evaluate(np.concatenate([np.clip(starts, done.low, done.high), done.samples(sampled, rng)]))
        if done.dimension <= _FEW:
            self._zoom(rng)
        elif done.left > 2 * (done.dimension + 1):
            done.climb(self._separated_best(), int(0.8 * done.left))
        while done.left > 0 and done.move_to_bounds(rng):
            pass
        return done.found()

    def _separated_best(self) -> Array:
        """Return some of the best points, each at a distance from all better ones."""
        points, values = self._evaluations.found()
        finite = points[:200][np.isfinite(values[:200])]
        reach = _SEPARATION * float(np.linalg.norm(self._evaluations.high - self._evaluations.low))
        return finite[separated_rows(finite, reach, _STARTS)]

    def _zoom(self, rng: np.random.Generator) -> None:
        """Sample ever closer to the best points: cheaper than slopes in few dimensions, and insensitive to kinks."""
        done = self._evaluations
        count = int(0.8 * done.left) // len(_ZOOMS)
        for share in _ZOOMS:
            best = self._separated_best()
            if not len(best) or not count:
                return
            moves = share * (done.high - done.low) * rng.normal(size=(count, done.dimension))
            done.evaluate(np.clip(np.resize(best, (count, done.dimension)) + moves, done.low, done.high))
