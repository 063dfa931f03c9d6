"""Search on a noisy system: every task is executed several times, and the mean distance is maximised."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.checked import PositiveInt, checked
from ctxval.searches.base import BaseSearch, Note, Prediction, Search, SequentialSearch


@dataclass(frozen=True, eq=False)
class _Means:
    """The distinct points of a history, in the order of their first evaluation.

    Attributes:
        points: the distinct points, shape ``(k, d)``.
        values: mean of the known values of each point, ``(k,)``; NaN if there are none.
        counts: number of evaluations of each point, including pending and failed ones, ``(k,)``.
        first: row of the first evaluation of each point in the history, ``(k,)``.
        evaluated: row of the first known value of each point among all known values, ``(k,)``; -1 if there is none.
        last: index of the point that was evaluated last.
    """

    points: Array
    values: Array
    counts: Rows
    first: Rows
    evaluated: Rows
    last: int

    @classmethod
    def of(cls, points: Array, values: Array, slots: Iterable[list[int]]) -> _Means:
        """Return the means of a history ``(n, d)``, ``(n,)``; ``slots`` are the rows of each distinct point."""
        groups = [np.array(group) for group in slots]
        known = np.isfinite(values)
        order = np.cumsum(known) - 1
        known_rows = [group[known[group]] for group in groups]
        return cls(
            points[[group[0] for group in groups]],
            np.array([values[found].mean() if len(found) else np.nan for found in known_rows]),
            np.array([len(group) for group in groups]),
            np.array([group[0] for group in groups]),
            np.array([order[found[0]] if len(found) else -1 for found in known_rows]),
            next(k for k, group in enumerate(groups) if group[-1] == len(points) - 1),
        )


@checked
class Repeated(SequentialSearch):
    """A search for the largest mean value of a noisy function: it asks for each point several times.

    It repeats a point that was told by hand as well, if that is the last point of the history.

    Args:
        search: the search that chooses the points; it is told the mean of the known values at each point.
        times: number of evaluations of each point.
    """

    def __init__(self, search: Search, times: PositiveInt = 3) -> None:
        self.search = search
        self.times = times
        self._inner = BaseSearch.of(search)
        self.initial = times * self._inner.initial
        self.discard = self._inner.discard

    def reset(self, dimension: int, seed: int) -> None:
        """Forget everything and start on the unit cube of this dimension."""
        super().reset(dimension, seed)
        self._prediction: Prediction | None = None

    @property
    def uses_prediction(self) -> bool:
        """Whether the search that chooses the points takes a prediction."""
        return self._inner.uses_prediction

    def use_prediction(self, prediction: Prediction | None) -> None:
        """Take the prediction for the search that chooses the points."""
        self._prediction = prediction

    def propose(self, rng: np.random.Generator) -> Array:
        """Return the last point again if it needs more evaluations; else a new point."""
        points = self.points
        means = _Means.of(points, self.values, self._slots.values()) if len(points) else None
        if means is not None and means.counts[means.last] < self.times:
            return np.asarray(means.points[means.last])
        self._inner.reset(self.dimension, self._seed)
        if means is not None:
            self._tell(means)
        point = np.asarray(self._inner.ask(1)[0])
        self._last_note = self._inner.note()
        return point

    def _tell(self, means: _Means) -> None:
        self._inner.tell(means.points, means.values)
        notes: list[Note | None] = [self.notes[row] for row in means.first.tolist()]
        self._inner.remember(notes)
        known = means.evaluated[np.isfinite(means.values)]
        self._inner.use_prediction(None if self._prediction is None else _by_point(self._prediction, known))

    def estimate(self, points: Array, values: Array) -> float | None:
        """Return the estimate of the largest mean, from the points with at least ``times`` known values.

        Returns None if there are too few such points.

        Args:
            points: points of the unit cube, shape ``(n, d)``.
            values: their values, shape ``(n,)``, finite.
        """
        groups: dict[bytes, list[int]] = {}
        for row, point in enumerate(points):
            groups.setdefault(point.tobytes(), []).append(row)
        whole = [rows for rows in groups.values() if len(rows) >= self.times]
        means = np.array([np.mean(values[rows]) for rows in whole])
        return self._inner.estimate(points[[rows[0] for rows in whole]], means)


def _by_point(prediction: Prediction, evaluated: Rows) -> Prediction:
    """Return a prediction whose rows count distinct points; ``evaluated`` has the row of one evaluation of each."""
    return prediction.with_rows(lambda one: lambda rows: one.left_out(evaluated[rows]))
