"""CMA-ES (Hansen and Ostermeier 2001) with restarts, a baseline for many executions."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.checked import PositiveFloat, PositiveInt
from ctxval._util.refusals import require_extra
from ctxval._util.registry import part
from ctxval.errors import InputError
from ctxval.searches.base import SequentialSearch

if TYPE_CHECKING:
    from cmaes import CMA

_library = partial(require_extra, "cmaes", "searches", "CMA-ES searches need")


@part("cma-es")
class CMAES(SequentialSearch):
    """Covariance matrix adaptation inside the unit cube, one point of a generation after the other.

    It starts at the centre of the cube. If a run has converged, another one starts from a random point with twice the
    population (IPOP; Auger and Hansen 2005). Every point that is told counts in its generation, even if another search
    or a person chose it.

    Args:
        sigma: standard deviation of the first generation on each axis, in widths of the cube.
        population: number of points in a generation; ``4 + floor(3 ln d)`` by default.

    Raises:
        InputError: if the population is smaller than 4.
    """

    def __init__(self, sigma: PositiveFloat = 0.3, population: PositiveInt | None = None) -> None:
        if population is not None and population < 4:
            raise InputError(f"CMA-ES needs a population of at least 4, got {population!r}.")
        _library()
        self.sigma, self.population = sigma, population

    def reset(self, dimension: int, seed: int) -> None:
        super().reset(dimension, seed)
        self._begin()

    def _begin(self) -> None:
        self._distribution = self._started(np.full(self.dimension, 0.5), self.population)
        self._learned = np.empty(0)

    def propose(self, rng: np.random.Generator) -> Array:
        """Return a draw from the distribution after all complete generations."""
        points, values = self.points, self.values
        with single_threaded():
            if not np.array_equal(values[: len(self._learned)], self._learned, equal_nan=True):
                self._begin()  # a late value belongs to a generation that was learned without it
            while (last := (first := len(self._learned)) + self._distribution.population_size) <= len(points):
                generation, results = points[first:last], values[first:last]
                known = np.isfinite(results)
                if known.any():  # failures rank last, and a generation of failures alone is left out
                    losses = np.where(known, -results, -results[known].min())
                    order = np.argsort(-results, kind="stable")  # NaN last
                    self._distribution.tell([(generation[i], float(losses[i])) for i in order])
                if self._distribution.should_stop() or (np.ptp(generation, axis=0) < 1e-4).all():
                    # Trial k draws from [seed, k]; the third number of the seed separates the restart from it.
                    restart = np.random.default_rng(np.random.SeedSequence([self._seed, last, 1]))
                    population = 2 * self._distribution.population_size
                    self._distribution = self._started(restart.random(self.dimension), population)
                self._learned = values[:last]
            self._distribution.reseed_rng(int(rng.integers(2**32)))
            return np.asarray(self._distribution.ask(), dtype=np.float64)

    def _started(self, mean: Array, population: int | None) -> CMA:
        bounds = np.tile([0.0, 1.0], (self.dimension, 1))
        return _library().CMA(mean=mean, sigma=self.sigma, bounds=bounds, population_size=population)
