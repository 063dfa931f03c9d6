"""Predictions of the distance from dynamics that are learned from executions.

The corrected model ``M_hat = M + r`` replaces the system. The distance predicted at p is the ordinary validation of M
against M_hat, with the controller designed at p. So the prediction includes jumps of the design.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.cores import on_all_cores
from ctxval._util.progress import advance
from ctxval.core.distance import ComposedDistance
from ctxval.core.rollout import rollout
from ctxval.core.validation import Validation
from ctxval.learning.dynamics import CorrectedModel, learn_corrected
from ctxval.learning.error_vectors import ErrorVectors, Executed
from ctxval.learning.recorded import closed_loops_on_model, recorded_transitions
from ctxval.learning.vector import predict_composed
from ctxval.searches import Prediction

_CENTRES = (100, 450)
"""Least and largest number of transitions that the residual is conditioned on."""
_WORK = 30_000
"""Number of these transitions times the horizon; it bounds the time of a closed loop."""
_DESIGNS = 2000
"""Number of designs for one suggestion, if the synthesizer takes batches."""
_SLOW_DESIGNS = 150
"""Number of designs for one suggestion, if the synthesizer takes one task at a time."""
_SLOW = 0.02
"""Seconds: if a single closed loop on M takes longer, closed loops are distributed over the cores."""


def predict_distance(
    validation: Validation, executed: Executed, errors: ErrorVectors | None = None
) -> Prediction | None:
    """Return a prediction of d at other points, from the executions so far and the data that the model was made from.

    Returns None if there are no recorded transitions, if M already explains them, or if no task can be planned.

    If the distance is composed of a short vector, such as the error of the final state, a second prediction models the
    vector as a function of p, because an error that is no function of state and input may still be a function of p.
    The first prediction offers the second one as ``otherwise``. If there is no first prediction, the second one is
    returned instead.

    Args:
        validation: the map p -> d(p).
        executed: points of the unit cube ``(d,)`` with the system's trajectories there.
        errors: keeps the vectors of earlier executions, so that a further suggestion computes only new ones.
    """
    otherwise = functools.partial(_predict_vectors, validation, executed, errors or ErrorVectors(validation))
    with single_threaded():
        found = _predict_distance(validation, executed)
        return otherwise() if found is None else replace(found, otherwise=otherwise)


def _predict_vectors(validation: Validation, executed: Executed, errors: ErrorVectors) -> Prediction | None:
    """Return the prediction from the vectors of which distances are composed; None if they are not known."""
    distance, vectors = validation.distance, errors.of(executed)
    if vectors is None or not isinstance(distance, ComposedDistance):
        return None
    return predict_composed(np.array([point for point, _ in executed]), vectors, distance.compose)


def _predict_distance(validation: Validation, executed: Executed) -> Prediction | None:
    started = time.perf_counter()
    loops = closed_loops_on_model(validation)
    seconds = time.perf_counter() - started
    if loops is None:
        return None
    recorded = recorded_transitions(validation.model, [trajectory for _, trajectory in executed], loops)
    if recorded is None:
        return None
    centres = int(np.clip(_WORK // loops.horizon, *_CENTRES))
    corrected = learn_corrected(validation.model, *recorded, centres)
    if corrected is None:
        return None
    batched = bool(loops.batch_shape)
    predicted = _PredictedDistance(
        validation, corrected, batched, executed, in_parallel=not batched and seconds > _SLOW
    )
    return Prediction(predicted, predicted.left_out, _DESIGNS if batched else _SLOW_DESIGNS)


@dataclass(frozen=True, eq=False)
class _PredictedDistance:
    """The validation of M against M_hat, as a function of points of the unit cube.

    Attributes:
        validation: the validation of M against S.
        corrected: the corrected model M_hat.
        batched: whether controllers are designed in batches.
        executed: executed points, with the trajectories from which M_hat was learned.
        in_parallel: whether closed loops are distributed over the cores; their results are the same.
    """

    validation: Validation
    corrected: CorrectedModel
    batched: bool
    executed: Executed
    in_parallel: bool

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Return the predicted distances ``(m,)``, and the doubt in the predicted trajectories ``(m,)``."""
        with single_threaded():
            if not self.in_parallel:
                return self._looped(points, self.corrected)
            parts = on_all_cores(functools.partial(self._looped, corrected=self.corrected), list(points[:, None, :]))
            return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def left_out(self, rows: Rows) -> Array:
        """Return the distances predicted at executed points, each from the executions of other points, ``(k,)``."""
        points = [self.executed[k][0] for k in rows.tolist()]
        with single_threaded():
            return np.array([self._looped(point[None], self._without(point))[0][0] for point in points])

    def _without(self, point: Array) -> CorrectedModel:
        there = [source for source, (other, _) in enumerate(self.executed) if np.array_equal(other, point)]
        return CorrectedModel(self.corrected.model, self.corrected.residual.without(there))

    def _looped(self, points: Array, corrected: CorrectedModel) -> tuple[Array, Array]:
        """Return distances and doubts ``(m,)``; NaN for a task that fails. A batch that fails is halved and retried."""
        if self.batched or len(points) == 1:
            try:
                found = self._closed_loops(points, corrected)
                advance(len(points))
                return found
            except Exception:  # the user's task, synthesizer or distance, on points that may never be executed
                if len(points) == 1:
                    return np.array([np.nan]), np.array([np.nan])
        half = len(points) // 2
        parts = [self._looped(part, corrected) for part in (points[:half], points[half:])]
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def _closed_loops(self, points: Array, corrected: CorrectedModel) -> tuple[Array, Array]:
        parts, space = self.validation, self.validation.space
        rows = points if self.batched else points[0]
        task = parts.task(space.parameters(space.from_unit(rows)))
        controller = parts.synthesizer.design(task, parts.model)
        promised = rollout(parts.model.step, controller, task)
        predicted = rollout(corrected.step, controller, task)
        with np.errstate(all="ignore"):
            distance = np.reshape(parts.distance(promised, predicted, task), len(points))
            doubt = np.reshape(corrected.residual.unfamiliarity(predicted), len(points))
        finite = np.isfinite(distance) & np.isfinite(doubt)
        return np.where(finite, distance, np.nan), np.where(finite, doubt, np.nan)
