"""The distance over the tasks as the trials show it: a Gaussian process whose bands are never below zero."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Trial
from ctxval.gp.regression import GaussianProcess
from ctxval.gp.surrogate import SurrogateHyperparameters, learn, spread_rows


def distance_of(trial: Trial) -> float:
    """Return the distance of a completed trial."""
    assert trial.distance is not None
    return trial.distance


class Band(NamedTuple):
    """The medians of predicted distances ``(m,)``, and the ends of their bands of 95 %; none is below 0."""

    median: Array
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class DistanceModel:
    """The Gaussian process of the distance, or of its logarithm if that fits clearly better."""

    points: Array  #: points of the unit cube with a known distance ``(n, d)``
    values: Array  #: their distances ``(n,)``
    learned: SurrogateHyperparameters  #: its hyperparameters and its scale
    process: GaussianProcess  #: the process, conditioned on the distances
    tasks: Array  #: random tasks, or all tasks of a suite, points of the unit cube ``(m, d)``

    @classmethod
    def of(cls, completed: Sequence[Trial], space: TaskSpace) -> DistanceModel | None:
        """Return the model of trials with a distance; None if they are fewer than two, or none can be fitted."""
        if len(completed) < 2:
            return None
        points, values = np.array([trial.unit_point for trial in completed]), np.array([*map(distance_of, completed)])
        rows = spread_rows(values, 500)
        points, values = points[rows], values[rows]
        with single_threaded(), np.errstate(all="ignore"):
            learned = learn(points, values)
            process = learned.condition(points, values)
        tasks = space.candidates(np.random.default_rng(0).random((4096, space.dimension)))
        return cls(points, values, learned, process, tasks) if np.isfinite(process.alpha).all() else None

    def predict(self, points: Array) -> Band:
        """Return the distances predicted at points of the unit cube ``(m, d)``."""
        with single_threaded():
            return self._band(*self.process.predict(points))

    @functools.cached_property
    def left_out(self) -> Band:
        """The distance of each trial as all other trials predict it."""
        return self._band(*self.process.left_out())

    @functools.cached_property
    def calibration(self) -> float:
        """Root mean square of the standardised leave-one-out errors; about 1 if the bands are as wide as the errors."""
        mean, variance = self.process.left_out()
        return float(np.sqrt(np.mean((self.process.y - mean) ** 2 / np.maximum(variance, 1e-300))))

    @functools.cached_property
    def over_tasks(self) -> Band:
        """The distances predicted at these tasks."""
        return self.predict(self.tasks)

    @functools.cached_property
    def sensitivity(self) -> Array:
        """Total Sobol index of each parameter ``(d,)``: its share, with interactions, in the variance."""
        d = self.points.shape[1]
        if d == 1:
            return np.ones(1)
        from scipy.stats import sobol_indices, uniform  # imported here, because it is slow to load

        with np.errstate(all="ignore"):
            # A power of two; d + 2 times as many tasks are predicted.
            indices = sobol_indices(func=lambda x: self.predict(x.T).median[None], n=256, dists=[uniform()] * d, rng=0)
        return np.asarray(np.clip(np.nan_to_num(np.ravel(indices.total_order)), 0.0, 1.0))

    @property
    def influence(self) -> list[int]:
        """The parameters, the one to which the distance is most sensitive first."""
        return [int(j) for j in np.argsort(-self.sensitivity, kind="stable")]

    def _band(self, mean: Array, variance: Array) -> Band:
        half = 1.96 * np.sqrt(np.maximum(variance, 0.0))  # a band of 95 %
        with np.errstate(all="ignore"):
            ends = (self.learned.shift + self.learned.scale * end for end in (mean, mean - half, mean + half))
            return Band(*(np.maximum(self.learned.warp.backward(end), 0.0) for end in ends))
