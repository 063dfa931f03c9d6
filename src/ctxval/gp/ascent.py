"""Maximising a function without gradients over a box, in few and large batches.

Many of these maxima lie at corners of the box, so corners are sampled more densely. The search is local: it ends at the
maxima whose slopes the first samples have met. :mod:`ctxval.gp.global_search` looks for maxima that are rare.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.boxes import Box, climb, moves_to_bounds, separated_rows

Values = Callable[[Array], Array]  # points (m, d) -> values (m,)


@dataclass(frozen=True)
class AscentSettings:
    """Sizes of a local search; shares of a line search are those of the way to a corner."""

    few: int = 3  # largest dimension in which samples ever closer to the best points replace the climbs
    pool: int = 128  # points in few dimensions that are the same in each search, for each dimension
    zoomed: int = 6  # points that are sampled around
    samples: int = 18  # samples in each of 1, 3 and 5 rounds in 1, 2 and 3 dimensions, for each dimension
    moved: int = 3  # best points of which single coordinates are moved to bounds in each round
    starts: int = 10  # points from which the function, or its approximation, is climbed
    rounds: int = 3  # line searches of each climb
    refined: int = 16  # points at which the function itself is evaluated after its approximation
    finalists: int = 3  # points from which the function itself is climbed after its approximation
    final_rounds: int = 2  # line searches of these climbs
    shares: tuple[float, ...] = (0.03, 0.1, 0.3, 0.6, 1.0)  # steps of a line search
    lengths: tuple[float, ...] = (0.1, 0.4)  # steps along the slopes, as shares of the box in the steepest coordinate
    # shares of the coordinates that are moved to the corner alone, at least one each
    coordinates: tuple[float, ...] = (0.0, 0.25, 0.5)

    def line_cost(self, dimension: int) -> int:
        """Return the number of evaluations of one line search from one point."""
        return dimension + 1 + len(self.shares) + len(self.lengths) + len(self.coordinates)


class Evaluations:
    """The evaluations of a function over a box, within a budget that only a climb may exceed, if it is not strict."""

    def __init__(self, function: Values, low: Array, high: Array, budget: int, *, strict: bool = True) -> None:
        self.low, self.high, self.dimension = low, high, len(low)
        self.budget, self.strict, self._function = budget, strict, function
        self._points, self._values = [np.empty((0, len(low)))], [np.empty(0)]

    @property
    def left(self) -> int:
        """How many evaluations the budget still allows."""
        return self.budget - sum(map(len, self._values))

    def evaluate(self, points: Array) -> Array:
        """Return the values ``(m,)`` at points ``(m, d)``; minus infinity if not finite or beyond the budget."""
        asked = points[: max(0, self.left)] if self.strict else points
        values = np.full(len(points), -np.inf)
        if len(asked):
            known = np.asarray(self._function(asked), dtype=np.float64)
            values[: len(asked)] = np.where(np.isfinite(known), known, -np.inf)
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

    def finite(self) -> Array:
        """Return the points ``(m, d)`` whose values are finite, the largest value first."""
        points, values = self.best_first()
        return points[np.isfinite(values)]

    def best_first(self) -> tuple[Array, Array]:
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
        scale, box = max(float(np.abs(self.best_first()[1][0])), 1e-300), (self.low, self.high)
        calls = max(2, budget // (len(starts) * (self.dimension + 1)))
        climb(lambda Z: self._slopes(np.clip(Z, *box)), starts, *box, scale=scale, iterations=calls, evaluations=calls)

    def search_lines(self, starts: Array, rounds: int, settings: AscentSettings) -> None:
        """Search along lines from all starts ``(s, d)`` at once, several times.

        Each line leads along the slopes, or to the corner to which they point (Frank and Wolfe 1956), where convex
        functions have their maxima. Some steps move only the coordinates that promise most.
        """
        points, row = starts, np.arange(len(starts))
        counts = np.maximum(1, (np.array(settings.coordinates) * self.dimension).astype(int))
        shares, lengths = (np.array(steps)[:, None] for steps in (settings.shares, settings.lengths))
        for _ in range(rounds):
            here, slopes = self._slopes(points)
            ways = np.where(slopes > 0, self.high, self.low) - points
            rank = np.argsort(np.argsort(-np.abs(slopes * ways), axis=1, kind="stable"), axis=1)
            few = np.where(rank[:, None] < counts[:, None], ways[:, None], 0.0)
            steepest = slopes / np.maximum(np.abs(slopes).max(axis=1, keepdims=True), 1e-300) * (self.high - self.low)
            moves = [shares * ways[:, None], lengths * steepest[:, None], few]
            moved = np.clip(points[:, None] + np.concatenate(moves, axis=1), self.low, self.high)  # (s, q, d)
            values = self.evaluate(moved.reshape(-1, self.dimension)).reshape(moved.shape[:2])
            best = values.argmax(axis=1)
            better = values[row, best] > here
            points = np.where(better[:, None], moved[row, best], points)
            if not better.any():
                return

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
        (points, values), d = self.best_first(), self.dimension
        best, ends = points[:3], np.stack([self.low, self.high])
        single = moves_to_bounds(best[0], self.low, self.high)
        parents = best[rng.integers(len(best), size=2 * d)]
        moves = rng.random(parents.shape) < 2 / d
        several = np.where(moves, ends[rng.integers(2, size=parents.shape), np.arange(d)], parents)
        gain = 1e-9 * abs(values[0]) if np.isfinite(values[0]) else 0.0
        moved = np.concatenate([single, several])[: max(1, self.left)]
        return bool(self.evaluate(moved).max() > values[0] + gain)


def ascend(
    function: Values, box: Box, budget: int, starts: Array, rng: np.random.Generator, rough: Values | None = None,
    settings: AscentSettings = AscentSettings(),
) -> tuple[Array, Array]:  # fmt: skip
    """Search a box within the unit cube for the maximum; return all points ``(m, d)`` and values, the largest first.

    In few dimensions, the points of a fixed pool are evaluated, and then samples ever closer to the best ones. In more
    dimensions the function is sampled, and line searches start from the best samples, all at once, along slopes and
    towards the corner to which they point. Then coordinates are moved to the box's bounds. If there is a cheap
    approximation of the function, it is searched first, and the function itself is evaluated near the best points only;
    few dimensions need no approximation.

    Values that are not finite are never a maximum. The budget of evaluations may be exceeded by the last climb. Starts
    ``(s, d)`` are evaluated first.
    """
    exact, inside = Evaluations(function, *box, budget, strict=False), np.clip(starts, *box)
    if exact.dimension <= settings.few:
        _search_few(exact, inside, rng, settings)
    else:
        approximation = exact if rough is None else Evaluations(rough, *box, budget, strict=False)
        _search_many(exact, approximation, inside, rng, settings)
    return exact.best_first()


def _search_few(exact: Evaluations, starts: Array, rng: np.random.Generator, settings: AscentSettings) -> None:
    """Sample ever closer to the best points: cheaper than slopes in few dimensions, and insensitive to kinks."""
    d, low, high = exact.dimension, exact.low, exact.high
    # A pool that fills the unit cube evenly and reaches its faces: a Kronecker sequence of generalised golden ratios
    # (Roberts 2018, "The unreasonable effectiveness of quasirandom sequences").
    size, ratio = min(settings.pool * d, exact.budget // 3), 2.0
    for _ in range(30):
        ratio = (1 + ratio) ** (1 / (d + 1))
    pool = (0.5 + np.arange(1, size + 1)[:, None] * ratio ** -np.arange(1.0, d + 1)) % 1
    margin = 0.5 / size ** (1 / d)
    pool = np.clip((1 + 2 * margin) * pool - margin, 0, 1)
    exact.evaluate(starts)
    exact.evaluate_inside(pool)
    best, gap = _best(exact, settings.zoomed), size ** (-1 / d)
    for _ in range(2 * d - 1):
        corners = moves_to_bounds(best[: settings.moved], low, high).reshape(-1, d)
        count = min(settings.samples * d, exact.left - len(best) - len(corners))
        if not len(best) or count < 1:
            return
        steps = np.resize((1.0, 0.3, 0.1), count)[:, None] * np.minimum(gap, 0.3 * (high - low))
        near = np.resize(best, (count, d)) + steps * rng.normal(size=(count, d))
        exact.evaluate(np.concatenate([best, np.clip(near, low, high), corners]))
        best, gap = _best(exact, settings.zoomed), 0.5 * gap


def _search_many(
    exact: Evaluations, rough: Evaluations, starts: Array, rng: np.random.Generator, settings: AscentSettings
) -> None:
    """Climb from the best samples, on the approximation first; both share the budget."""

    def left() -> int:
        return exact.left - (0 if rough is exact else rough.budget - rough.left)

    def climb(on: Evaluations, starts: int, rounds: int) -> None:
        allowed = left() // (rounds * settings.line_cost(on.dimension))
        if allowed:
            on.search_lines(_best(on, min(starts, allowed)), rounds, settings)

    rough.evaluate(np.concatenate([starts, rough.samples(max(8, rough.budget // 6), rng)]))
    climb(rough, settings.starts, settings.rounds)
    if rough is not exact:
        exact.evaluate(np.concatenate([starts, _best(rough, settings.refined, 0.02)]))
    climb(exact, settings.finalists, settings.final_rounds)
    for _ in range(4):
        if left() < 1 or not exact.move_to_bounds(rng):
            return


@dataclass(frozen=True)
class Effort:
    """What a search usually evaluates; one that goes on improving evaluates up to half as much again."""

    exact: int  # number of points at which the function itself is evaluated
    rough: int  # number of points at which its approximation is evaluated
    batches: int  # number of calls in which all of these are evaluated


def usual_effort(dimension: int, budget: int, settings: AscentSettings = AscentSettings()) -> Effort:
    """Return what a search with this budget usually evaluates, if the function has an approximation."""
    if dimension <= settings.few:
        first = settings.starts + min(settings.pool * dimension, budget // 3)
        each = settings.zoomed + (settings.samples + 2 * settings.moved) * dimension
        exact = min(budget, first + (2 * dimension - 1) * each)
        return Effort(exact, 0, 2 + -(-(exact - first) // each))
    line, rounds = settings.line_cost(dimension), settings.rounds - 1  # most climbs end before their last round
    rough = min(budget, settings.starts + max(8, budget // 6))
    climbs = min(settings.starts, (budget - rough) // (settings.rounds * line))
    rough += rounds * line * climbs
    exact = min(budget - rough, settings.starts + settings.refined)
    finals = min(settings.finalists, (budget - rough - exact) // (settings.final_rounds * line))
    exact += line * finals
    exact += min(budget - rough - exact, 4 * dimension)
    return Effort(exact, rough, 3 + (2 * rounds if climbs else 0) + (3 if finals else 0))


def _best(done: Evaluations, count: int, share: float = 0.1) -> Array:
    finite = done.finite()
    reach = share * float(np.linalg.norm(done.high - done.low))
    return finite[separated_rows(finite, reach, count)]
