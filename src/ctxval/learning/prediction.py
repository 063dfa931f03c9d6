"""The distance that learned dynamics predict as a function of the task, and distances composed of a short vector.

The corrected model ``M_hat = M + r``, with the posterior mean of the residual, replaces the system. The distance
predicted at p is the ordinary validation of M against M_hat, with the controller designed at p. So the prediction
includes jumps of the design.

A norm has kinks where the vector is smooth, and each evaluation shows the whole vector, such as the error of the final
state. So the vector is modelled by Gaussian processes that share a covariance, one for each entry, and values are
composed of predicted vectors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.cores import on_all_cores
from ctxval._util.progress import advance
from ctxval.core.distance import ComposedDistance
from ctxval.core.trajectory import Trajectory
from ctxval.errors import ShapeError
from ctxval.gp.kernels import Matern
from ctxval.gp.regression import MultiOutputProcess, log_likelihood_of_outputs, most_likely
from ctxval.learning.closed_loops import LoopPlanner, halved
from ctxval.learning.draws import DynamicsDraws
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.searches import Prediction

Executed = Sequence[tuple[Array, Trajectory]]  # points of the unit cube (d,) with the system's trajectories there
_KERNEL = Matern(2.5, ard=True, length_scale=(0.05, 100.0), variance=(1e-6, 1e3), linear=(1e-6, 1e3))
_NOISE = 1e-8  # noise variance relative to the vectors' mean square: it keeps the covariance matrix positive definite


@dataclass(frozen=True, eq=False)
class PredictedDistance:
    """The validation of M against M_hat, as a function of points of the unit cube."""

    planner: LoopPlanner
    posterior: DynamicsPosterior
    executed: Array  # executed points (n, d), in the order of the executions that the posterior knows
    in_parallel: bool  # whether closed loops are distributed over the cores; their results are the same
    mean: DynamicsDraws

    _known: dict[bytes, tuple[float, float]] = field(default_factory=dict, init=False)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Return the predicted distances ``(m,)``, and the doubt in the predicted trajectories ``(m,)``."""
        keys = [point.tobytes() for point in points]
        new = [row for row, key in enumerate(keys) if key not in self._known]
        if new:
            with single_threaded():
                if self.in_parallel and not all(map(self.planner.has, points[new])):
                    predicted = np.concatenate(on_all_cores(self._predicted, list(points[new, None])), axis=1)
                else:
                    predicted = self._predicted(points[new])
            predicted = np.where(np.isfinite(predicted).all(axis=0), predicted, np.nan)
            self._known.update(zip((keys[row] for row in new), map(tuple, predicted.T.tolist()), strict=True))
        distance, doubt = np.array([self._known[key] for key in keys]).reshape(-1, 2).T
        return distance, doubt

    def left_out(self, points: Array) -> Array:
        """Return the distances predicted at points, each from the executions of other points, ``(k,)``."""
        executions = executions_of(self.executed, points)
        is_executed = np.array([bool(rows) for rows in executions])
        distances, known = np.empty(len(points)), points[is_executed]
        if not is_executed.all():  # a distance without a recording teaches nothing that could be left out
            distances[~is_executed] = self(points[~is_executed])[0]
        if len(known):
            without = self.posterior.means_without(list(filter(None, executions)))
            distances_on = self.planner.own_distances
            with single_threaded():
                parts = halved(lambda some: distances_on(without[some], known[some, None])[:, 0], len(known))
            distances[is_executed] = np.concatenate([[np.nan] if part is None else part for _, part in parts])
        return np.where(np.isfinite(distances), distances, np.nan)

    def _predicted(self, points: Array) -> Array:
        """Return distances and doubts ``(2, m)``; NaN for a task that cannot be planned or where a part fails."""

        def closed_loops(some: Rows) -> Array:
            predicted = np.full((2, len(some)), np.nan)
            planned = self.planner.plan(points[some])
            for plan, loops in zip(planned, self.planner.run(self.mean, planned), strict=True):
                with np.errstate(all="ignore"):
                    doubt = self.posterior.unfamiliarity(loops.states[0], loops.inputs[0])
                predicted[:, plan.rows] = loops.distances[0], doubt
            return predicted

        parts = [part for _, part in halved(closed_loops, len(points))]
        return np.concatenate([np.full((2, 1), np.nan) if part is None else part for part in parts], axis=1)


def executions_of(executed: Array, points: Iterable[Array]) -> list[list[int]]:
    """Return the rows of executed points ``(n, d)`` at each of some points ``(d,)``."""
    return [np.flatnonzero((executed.reshape(-1, len(point)) == point).all(axis=1)).tolist() for point in points]


class ErrorVectors:
    """Computes the vectors of executions; each needs the design of a controller, so it is kept like its trajectory."""

    def __init__(self, planner: LoopPlanner) -> None:
        self.validation = planner.validation
        self._planner = planner
        self._known: WeakKeyDictionary[Trajectory, Array] = WeakKeyDictionary()

    def of(self, executed: Executed) -> Array | None:
        """Return the vectors ``(n, k)`` of two executions or more; None if a vector cannot be computed."""
        distance, validation = self.validation.distance, self.validation
        if not isinstance(distance, ComposedDistance) or len(executed) < 2:
            return None
        try:
            for point, trajectory in executed:
                if trajectory in self._known:
                    continue
                if self._planner.batched:
                    plan = validation.plan(validation.space.from_unit(point))
                    advance()
                    task, nominal = plan.task, plan.model_trajectory
                else:
                    (planned,) = self._planner.plan(point[None])
                    task, nominal = planned.task, planned.nominal
                # Some distances change the arrays that they are given.
                self._known[trajectory] = distance.error(nominal.copy(), trajectory.copy(), task)
            errors = np.array([self._known[trajectory] for _, trajectory in executed])
        except Exception:  # the user's own parts: a distance may reject even tasks that were executed
            return None
        return errors if errors.ndim == 2 and np.isfinite(errors).all() else None


def predict_composed(
    points: Array, vectors: Array, compose: Callable[[Array], Array], learned_from: int = 200
) -> Prediction | None:
    """Return a prediction of values composed of vectors ``(n, k)`` at points; None for less than two, or only zeros.

    Hyperparameters are learned from so many vectors, the latest ones.
    """
    if points.ndim != 2 or vectors.ndim != 2 or len(points) != len(vectors):
        raise ShapeError(f"points must be (n, d) and vectors (n, k), got {points.shape}, {vectors.shape}.")
    scale = float(np.sqrt((vectors**2).mean())) if len(vectors) else 0.0
    if len(vectors) < 2 or scale == 0:
        return None
    with single_threaded():
        theta = _most_likely(points[-learned_from:], vectors[-learned_from:] / scale)
    process = MultiOutputProcess(_KERNEL, theta, points, vectors / scale, _NOISE)

    def expected(at: Array) -> tuple[Array, Array]:
        """Return the values composed of the expected vectors ``(m,)``, and the relative deviation of draws ``(m,)``."""
        with single_threaded():
            mean, variance = process.predict(at)
        values = np.asarray(compose(scale * mean))
        # The draws are the same at all points and in all calls, so that the result is a function of the point.
        draws = np.random.default_rng(0).normal(size=(32, 1, mean.shape[1]))
        drawn = compose(scale * (mean + np.sqrt(variance)[:, None] * draws))
        deviation = np.sqrt(((drawn - values) ** 2).mean(axis=0))
        return values, deviation / np.maximum(np.abs(values), 1e-12 * scale)

    def left_out(at: Array) -> Array:
        executions, values = executions_of(points, at), np.empty(len(at))
        known = np.array([bool(rows) for rows in executions])
        if not known.all():
            values[~known] = expected(at[~known])[0]
        if known.any():
            rows = np.array([rows[0] for rows in executions if rows])
            values[known] = compose(scale * process.left_out(rows))
        return values

    # Many points may be predicted, because no controller is designed for them.
    return Prediction(expected, left_out, 6000)


def _most_likely(X: Array, Y: Array) -> Array:
    """Return the hyperparameters that make vectors ``(n, k)``, their entries independent, most likely a posteriori."""
    d = X.shape[1]
    variance, length, constant, slope = np.log((0.1, 0.5, 0.1, 1.0))  # prior medians, where the climb starts
    medians = np.array([variance, *[length + 0.5 * np.log(d)] * d, constant, slope])
    deviations = np.array([3.0, *[1.0] * d, *[3.0] * 2])

    def log_density(theta: Array) -> tuple[float, Array]:
        away = (theta - medians) / deviations
        value, W = log_likelihood_of_outputs(_KERNEL(theta, X, X), _NOISE, Y)
        return value - 0.5 * float(away @ away), _KERNEL.weighted_gradient(theta, X, W) - away / deviations

    return most_likely(log_density, medians[None], _KERNEL.bounds(d))
