"""What the searches of functions without gradients have in common: a budget, samples, climbs and moves to bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.boxes import climb, moves_to_bounds

Values = Callable[[Array], Array]
"""Points ``(m, d)`` -> values ``(m,)``."""

_SHARES = np.array([0.03, 0.1, 0.3, 0.6, 1.0])  # steps of a line search, as shares of the way to a corner
_LENGTHS = np.array([0.1, 0.4])  # steps along the slopes, as shares of the box in the steepest coordinate
_COORDINATES = (0.0, 0.25, 0.5)
"""Shares of the coordinates that are moved to the corner alone, at least one coordinate each."""


class Evaluations:
    """The evaluations of a function over a box within the unit cube, no more of them than a budget.

    Args:
        function: points ``(m, d)`` -> values ``(m,)``; values that are not finite are never a maximum.
        budget: number of points at which the function may be evaluated.
        strict: whether the budget is a hard limit; if not, a climb that has begun may exceed it.
    """

    def __init__(self, function: Values, low: Array, high: Array, budget: int, *, strict: bool = True) -> None:
        self.strict = strict
        self.low, self.high = low, high
        self.budget = budget
        self._function = function
        self._points: list[Array] = [np.empty((0, len(low)))]
        self._values: list[Array] = [np.empty(0)]

    @property
    def dimension(self) -> int:
        """The number of coordinates of a point."""
        return len(self.low)

    @property
    def left(self) -> int:
        """How many evaluations the budget still allows."""
        return self.budget - sum(map(len, self._values))

    def evaluate(self, points: Array) -> Array:
        """Return the values ``(m,)`` at points ``(m, d)``; minus infinity if not finite or beyond the budget."""
        asked = points[: max(0, self.left)] if self.strict else points
        values = np.full(len(points), -np.inf)
        if len(asked):
            found = np.asarray(self._function(asked), dtype=np.float64)
            values[: len(asked)] = np.where(np.isfinite(found), found, -np.inf)
            self._points.append(asked)
            self._values.append(values[: len(asked)])
        return values

    def evaluate_inside(self, points: Array) -> None:
        """Evaluate points ``(m, d)`` of which some may be outside of the box; their values do not count."""
        inside = ((points >= self.low) & (points <= self.high)).all(axis=1)
        values = np.asarray(self._function(points), dtype=np.float64)[inside]
        self._points.append(points[inside])
        self._values.append(np.where(np.isfinite(values), values, -np.inf))

    def in_order(self) -> tuple[Array, Array]:
        """Return all points ``(m, d)`` and their values ``(m,)`` as they were evaluated."""
        return np.concatenate(self._points), np.concatenate(self._values)

    def found(self) -> tuple[Array, Array]:
        """Return all points ``(m, d)`` and their values ``(m,)``, the largest first."""
        points, values = self.in_order()
        order = np.argsort(-values, kind="stable")
        return points[order], values[order]

    def samples(self, count: int, rng: np.random.Generator) -> Array:
        """Return uniform points; in every second one, a random share of the coordinates is moved to bounds."""
        points = self.low + rng.random((count, self.dimension)) * (self.high - self.low)
        ends = np.where(rng.random(points.shape) < 0.5, self.low, self.high)
        snapped = rng.random(points.shape) < np.where(np.arange(count) % 2, rng.random(count), 0.0)[:, None]
        return np.where(snapped, ends, points)

    def climb(self, starts: Array, budget: int) -> None:
        """Climb from starts ``(s, d)`` along finite differences, with about so many evaluations."""
        if not len(starts):
            return
        scale = max(float(np.abs(self.found()[1][0])), 1e-300)
        calls = max(2, budget // (len(starts) * (self.dimension + 1)))

        def sloped(points: Array) -> tuple[Array, Array]:
            return self._slopes(np.clip(points, self.low, self.high))

        climb(sloped, starts, self.low, self.high, scale=scale, iterations=calls, evaluations=calls)

    def search_lines(self, starts: Array, rounds: int) -> None:
        """Search along lines from all starts ``(s, d)`` at once, several times.

        Each line leads along the slopes, or to the corner to which they point (Frank and Wolfe 1956), where convex
        functions have their maxima. Some steps move only the coordinates that promise most.
        """
        points, row = starts, np.arange(len(starts))
        for _ in range(rounds):
            here, slopes = self._slopes(points)
            moved = self._along(points, slopes)
            values = self.evaluate(moved.reshape(-1, self.dimension)).reshape(moved.shape[:2])
            best = values.argmax(axis=1)
            better = values[row, best] > here
            points = np.where(better[:, None], moved[row, best], points)
            if not better.any():
                return

    def _along(self, points: Array, slopes: Array) -> Array:
        """Return points on the lines from each point, shape ``(s, q, d)``."""
        ways = np.where(slopes > 0, self.high, self.low) - points
        order = np.argsort(-np.abs(slopes * ways), axis=1, kind="stable")
        rank = np.argsort(order, axis=1)
        counts = np.maximum(1, (np.array(_COORDINATES) * self.dimension).astype(int))
        few = np.where(rank[:, None] < counts[:, None], ways[:, None], 0.0)
        steepest = slopes / np.maximum(np.abs(slopes).max(axis=1, keepdims=True), 1e-300) * (self.high - self.low)
        moves = [_SHARES[:, None] * ways[:, None], _LENGTHS[:, None] * steepest[:, None], few]
        return np.asarray(np.clip(points[:, None] + np.concatenate(moves, axis=1), self.low, self.high))

    def _slopes(self, points: Array) -> tuple[Array, Array]:

        n, d = points.shape
        steps = np.where(points + 1e-4 <= self.high, 1e-4, -1e-4)  # inward if a bound is near
        moved = points[:, None, :] + np.eye(d) * steps[:, None, :]
        values = self.evaluate(np.concatenate([points, moved.reshape(-1, d)]))
        here, there = values[:n], values[n:].reshape(n, d)
        with np.errstate(invalid="ignore"):
            slopes = (there - here[:, None]) / steps
        here = np.where(np.isfinite(here), here, 0.0)
        return here, np.where(np.isfinite(slopes), slopes, 0.0)

    def move_to_bounds(self, rng: np.random.Generator) -> bool:
        """Move coordinates of the best points to bounds, singly and several at a time; return whether that helped."""
        points, values = self.found()
        d = self.dimension
        best = points[:3]
        ends = np.stack([self.low, self.high])
        single = moves_to_bounds(best[0], self.low, self.high)
        parents = best[rng.integers(len(best), size=2 * d)]
        several = np.where(
            rng.random(parents.shape) < 2 / d, ends[rng.integers(2, size=parents.shape), np.arange(d)], parents
        )
        gain = 1e-9 * abs(values[0]) if np.isfinite(values[0]) else 0.0
        moved = np.concatenate([single, several])[: max(1, self.left)]
        return bool(self.evaluate(moved).max() > values[0] + gain)


def line_search_cost(dimension: int) -> int:
    """Return the number of evaluations of one line search from one point."""
    return dimension + 1 + len(_SHARES) + len(_LENGTHS) + len(_COORDINATES)
