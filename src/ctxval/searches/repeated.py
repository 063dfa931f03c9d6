"""Search on a noisy system: every task is executed several times, and the mean distance is maximised."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import PositiveInt, checked
from ctxval.searches.base import BaseSearch, Prediction, Search, SequentialSearch


@checked
class Repeated(SequentialSearch):
    """A search for the largest mean value of a noisy function: it asks for each point several times.

    It repeats a point that was told by hand as well, if that is the last point of the history.

    Args:
        search: the search that chooses the points; it is told the mean of the known values at each point.
        times: number of evaluations of each point.
    """

    def __init__(self, search: Search, times: PositiveInt = 3) -> None:
        self.search, self.times, self._inner = search, times, BaseSearch.of(search)
        self.initial, self.discard = times * self._inner.initial, self._inner.discard

    def reset(self, dimension: int, seed: int) -> None:
        super().reset(dimension, seed)
        self._prediction: Prediction | None = None

    @property
    def uses_prediction(self) -> bool:
        return self._inner.uses_prediction

    def use_prediction(self, prediction: Prediction | None) -> None:
        self._prediction = prediction

    def propose(self, rng: np.random.Generator) -> Array:
        """Return the last point ``(d,)`` again if it needs more evaluations; else a new point."""
        points, groups = self.points, [np.array(rows) for rows in self._slots.values()]  # the rows of each point
        for rows in groups:
            if rows[-1] == len(points) - 1 and len(rows) < self.times:
                return np.asarray(points[rows[0]])
        self._inner.reset(self.dimension, self._seed)
        if groups:
            values, known = self.values, np.isfinite(self.values)
            known_rows = [rows[known[rows]] for rows in groups]
            means = [values[rows].mean() if len(rows) else np.nan for rows in known_rows]
            self._inner.tell(points[[rows[0] for rows in groups]], means)
            self._inner.remember([self.notes[rows[0]] for rows in groups])
            self._inner.use_prediction(self._prediction)
        point = np.asarray(self._inner.ask(1)[0])
        self._last_note = self._inner.note()
        return point

    def estimate(self, points: Array, values: Array) -> float | None:
        """Return the estimate of the largest mean, from points ``(N, d)`` with at least ``times`` values, if any."""
        groups: dict[bytes, list[int]] = {}
        for row, point in enumerate(points):
            groups.setdefault(point.tobytes(), []).append(row)
        whole = [rows for rows in groups.values() if len(rows) >= self.times]
        means = np.array([np.mean(values[rows]) for rows in whole])
        return self._inner.estimate(points[[rows[0] for rows in whole]], means)
