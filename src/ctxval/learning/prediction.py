"""The distance that learned dynamics predict, as a function of the task.

The corrected model ``M_hat = M + r``, with the posterior mean of the residual, replaces the system. The distance
predicted at p is the ordinary validation of M against M_hat, with the controller designed at p. So the prediction
includes jumps of the design.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.cores import on_all_cores
from ctxval.learning.closed_loops import LoopPlanner, halved
from ctxval.learning.draws import DynamicsDraws
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.vector import executions_of
from ctxval.searches import Prediction


@dataclass(frozen=True, eq=False)
class PredictedDistance:
    """The validation of M against M_hat, as a function of points of the unit cube.

    Attributes:
        executed: executed points ``(n, d)``, in the order of the executions that the posterior knows.
        in_parallel: whether closed loops are distributed over the cores; their results are the same.
    """

    planner: LoopPlanner
    posterior: DynamicsPosterior
    executed: Array
    in_parallel: bool
    mean: DynamicsDraws

    _known: dict[bytes, tuple[float, float]] = field(default_factory=dict, init=False)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Return the predicted distances ``(m,)``, and the doubt in the predicted trajectories ``(m,)``."""
        keys = [point.tobytes() for point in points]
        new = [row for row, key in enumerate(keys) if key not in self._known]
        if new:
            with single_threaded():
                if self.in_parallel and not all(map(self.planner.has, points[new])):
                    found = np.concatenate(on_all_cores(self._predicted, list(points[new, None])), axis=1)
                else:
                    found = self._predicted(points[new])
            found = np.where(np.isfinite(found).all(axis=0), found, np.nan)
            self._known.update(zip((keys[row] for row in new), map(tuple, found.T.tolist()), strict=True))
        distance, doubt = np.array([self._known[key] for key in keys]).reshape(-1, 2).T
        return distance, doubt

    def left_out(self, rows: Rows) -> Array:
        """Return the distances predicted at executed points, each from the executions of other points, ``(k,)``."""
        points = self.executed[rows]
        without = self.posterior.means_without(executions_of(self.executed, points))

        with single_threaded():
            found = _nan_where_it_fails(
                lambda some: self.planner.own_distances(without[some], points[some, None]).T, len(rows), 1
            )[0]
        return np.where(np.isfinite(found), found, np.nan)

    def _predicted(self, points: Array) -> Array:
        """Return distances and doubts ``(2, m)``; NaN for a task that cannot be planned or where a part fails."""

        def closed_loops(some: Array) -> Array:
            found = np.full((2, len(some)), np.nan)
            planned = self.planner.plan(some)
            for plan, loops in zip(planned, self.planner.run(self.mean, planned), strict=True):
                with np.errstate(all="ignore"):
                    doubt = self.posterior.unfamiliarity(loops.states[0], loops.inputs[0])
                found[:, plan.rows] = loops.distances[0], doubt
            return found

        return _nan_where_it_fails(lambda rows: closed_loops(points[rows]), len(points), 2)


def _nan_where_it_fails(function: Callable[[Rows], Array], count: int, values: int) -> Array:
    parts = [np.full((values, 1), np.nan) if part is None else part for _, part in halved(function, count)]
    return np.concatenate(parts, axis=1)


def predict_distance(
    planner: LoopPlanner, posterior: DynamicsPosterior, executed: Array, in_parallel: bool = False
) -> Prediction:
    """Return the prediction of d for a search; the arguments are those of :class:`PredictedDistance`."""
    exact = PredictedDistance(planner, posterior, executed, in_parallel, posterior.mean)
    # If few centres do not suffice, both predictions are one, so that no task is predicted twice.
    rough_mean = posterior.rough_mean
    rough = exact if rough_mean is posterior.mean else replace(exact, mean=rough_mean)
    return Prediction(exact, exact.left_out, 2000 if planner.batched else 150, rough=rough)
