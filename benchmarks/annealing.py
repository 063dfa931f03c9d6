(
    """Simulated annealing (Kirkpatrick, Gelatt and Vecchi 1983) as a user's own search.

``Campaign(validation, search=Annealing())`` uses it.
"""
    ""
)

from __future__ import annotations

import numpy as np

from ctxval import Array
from ctxval.searches.base import SequentialSearch

_SMALLEST_MOVE = 0.1
"""Smallest size of the moves, which shrink with the temperature, as a share of their first size."""


class Annealing(SequentialSearch):
    """A Metropolis walk through the unit cube, at a temperature that falls geometrically.

    Each point is a Gaussian move from the current point of the walk, reflected at the faces of the cube, or sometimes a
    uniform draw. If its value is larger, the walk moves there; if not, it moves there with probability
    ``exp(-loss / T_k)``. At trial k, T_k is ``temperature * cooling ** k`` times the range of the values before it. The
    walk never moves to a failed point.

    Args:
        temperature: temperature at the start, as a share of the range of the values.
        cooling: factor of the temperature from one trial to the next.
        move: standard deviation of the first moves on each axis, in widths of the cube; it shrinks with the square
            root of the temperature.
        restart: probability of a uniform draw instead of a move.

    """

    def __init__(
        self, temperature: float = 0.1, cooling: float = 0.98, move: float = 0.2, restart: float = 0.05
    ) -> None:
        self.temperature = temperature
        self.cooling = cooling
        self.move = move
        self.restart = restart

    def propose(self, rng: np.random.Generator) -> Array:
        """Return a uniform draw, or a move from the current point of the walk."""
        points, values = self.points, self.values
        uniform = rng.random() < self.restart
        if uniform or not np.isfinite(values).any():
            return rng.random(self.dimension)
        shrunk = max(self.cooling ** (0.5 * len(values)), _SMALLEST_MOVE)
        place = points[self._walk(values)]
        return reflected(place + self.move * shrunk * rng.normal(size=self.dimension))

    def _walk(self, values: Array) -> int:
        """Return the number of the trial at which the walk is after all trials."""
        known = np.flatnonzero(np.isfinite(values))
        heights = values[known]
        ranges = np.maximum.accumulate(heights) - np.minimum.accumulate(heights)
        # All decisions use one stream, so a longer history has the same first draws. The third number of the seed
        # separates it from the stream [seed, k] of trial k. A loss is below T times an exponential variate with the
        # Metropolis probability.
        stream = np.random.default_rng(np.random.SeedSequence([self._seed, 0, 1]))
        tolerated = self.temperature * self.cooling**known * stream.standard_exponential(len(values))[known]
        place = 0
        for i in range(1, len(known)):
            if heights[place] - heights[i] <= tolerated[i] * ranges[i - 1]:
                place = i
        return int(known[place])


def reflected(points: Array) -> Array:
    """Return points reflected at the faces of the unit cube until they are inside."""
    remainder = np.mod(points, 2.0)
    return np.minimum(remainder, 2.0 - remainder)
