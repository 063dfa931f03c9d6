"""Maximising a function without gradients over a box, in few and large batches.

Many of these maxima lie at corners of the box, so corners are sampled more densely.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.boxes import climb, moves_to_bounds, separated_rows

Values = Callable[[Array], Array]
"""Points ``(m, d)`` -> values ``(m,)``."""

_STARTS = 6
"""Number of points from which the function is climbed."""
_POLISHED = 3
"""Number of best points whose coordinates are moved to bounds, several at a time."""
_STEP = 1e-4
"""Step of the one-sided differences."""
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
        budget: number of points at which the function may be evaluated.
    """

    def __init__(self, function: Values, low: Array, high: Array, budget: int) -> None:
        self._function = function
        self._low, self._high = low, high
        self._budget = budget
        self._points: list[Array] = []
        self._values: list[Array] = []

    def run(self, starts: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return points ``(m, d)`` and values ``(m,)`` that were evaluated, the largest first.

        Args:
            starts: points ``(s, d)`` to evaluate first.
            rng: the source of the samples.
        """
        sampled = max(8, self._budget // 3)
        self._evaluate(np.concatenate([np.clip(starts, self._low, self._high), self._samples(sampled, rng)]))
        if len(self._low) <= _FEW:
            self._zoom(rng)
        elif self._left() > 2 * (len(self._low) + 1):
            self._climb(self._separated_best())
        while self._left() > 0 and self._polish(rng):
            pass
        return self._found()

    def _left(self) -> int:
        return self._budget - sum(map(len, self._values))

    def _evaluate(self, points: Array) -> Array:
        values = np.asarray(self._function(points), dtype=np.float64)
        values = np.where(np.isfinite(values), values, -np.inf)
        self._points.append(points)
        self._values.append(values)
        return values

    def _found(self) -> tuple[Array, Array]:
        points, values = np.concatenate(self._points), np.concatenate(self._values)
        order = np.argsort(-values, kind="stable")
        return points[order], values[order]

    def _samples(self, count: int, rng: np.random.Generator) -> Array:
        """Return uniform points; in every second one, a random share of the coordinates is moved to bounds."""
        points = self._low + rng.random((count, len(self._low))) * (self._high - self._low)
        ends = np.where(rng.random(points.shape) < 0.5, self._low, self._high)
        snapped = rng.random(points.shape) < np.where(np.arange(count) % 2, rng.random(count), 0.0)[:, None]
        return np.where(snapped, ends, points)

    def _separated_best(self) -> Array:
        """Return some of the best points, each at a distance from all better ones."""
        points, values = self._found()
        finite = points[np.isfinite(values)]
        reach = _SEPARATION * float(np.linalg.norm(self._high - self._low))
        return finite[separated_rows(finite, reach, _STARTS)]

    def _zoom(self, rng: np.random.Generator) -> None:
        """Sample ever closer to the best points: cheaper than slopes in few dimensions, and insensitive to kinks."""
        count = int(0.8 * self._left()) // len(_ZOOMS)
        for share in _ZOOMS:
            best = self._separated_best()
            if not len(best) or not count:
                return
            moves = share * (self._high - self._low) * rng.normal(size=(count, len(self._low)))
            self._evaluate(np.clip(np.resize(best, (count, len(self._low))) + moves, self._low, self._high))

    def _climb(self, starts: Array) -> None:
        """Climb from all starts at once along finite differences; the points reached are among those evaluated."""
        if not len(starts):
            return
        scale = max(float(np.abs(self._found()[1][0])), 1e-300)
        batch = len(starts) * (len(self._low) + 1)
        calls = max(2, int(0.8 * self._left()) // batch)

        def sloped(points: Array) -> tuple[Array, Array]:
            return self._slopes(np.clip(points, self._low, self._high))

        climb(sloped, starts, self._low, self._high, scale=scale, iterations=calls, evaluations=calls)

    def _slopes(self, points: Array) -> tuple[Array, Array]:
        """Return values and slopes by one-sided differences, which point inward if a bound is near."""
        n, d = points.shape
        steps = np.where(points + _STEP <= self._high, _STEP, -_STEP)
        moved = points[:, None, :] + np.eye(d) * steps[:, None, :]
        values = self._evaluate(np.concatenate([points, moved.reshape(-1, d)]))
        here, there = values[:n], values[n:].reshape(n, d)
        with np.errstate(invalid="ignore"):
            slopes = (there - here[:, None]) / steps
        here = np.where(np.isfinite(here), here, 0.0)
        return here, np.where(np.isfinite(slopes), slopes, 0.0)

    def _polish(self, rng: np.random.Generator) -> bool:
        """Move coordinates of the best points to bounds, singly and several at a time; return whether that helped."""
        points, values = self._found()
        d = len(self._low)
        best = points[:_POLISHED]
        ends = np.stack([self._low, self._high])
        single = moves_to_bounds(best[0], self._low, self._high)
        parents = best[rng.integers(len(best), size=2 * d)]
        several = np.where(
            rng.random(parents.shape) < 2 / d, ends[rng.integers(2, size=parents.shape), np.arange(d)], parents
        )
        moved = np.concatenate([single, several])
        gain = 1e-9 * abs(values[0]) if np.isfinite(values[0]) else 0.0
        return bool(self._evaluate(moved[: max(1, self._left())]).max() > values[0] + gain)
