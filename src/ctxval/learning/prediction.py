"""Predictions of the distance from dynamics that are learned from executions.

The corrected model ``M_hat = M + r`` replaces the system. The distance predicted at p is the ordinary validation of M
against M_hat, with the controller designed at p. So the prediction includes jumps of the design.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.cores import on_all_cores
from ctxval._util.describe import describe
from ctxval._util.representation import call
from ctxval.core.distance import ComposedDistance
from ctxval.core.model import Model, Step
from ctxval.core.rollout import rollout
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.closed_loops import PlannedTasks
from ctxval.learning.dynamics import (
    CorrectedModel,
    LearnedCovariance,
    Residual,
    learn_covariance,
    learn_residual,
)
from ctxval.learning.error_vectors import ErrorVectors, Executed, executions_of
from ctxval.learning.plan_memory import PlanMemory
from ctxval.learning.recorded import affordable_centres, closed_loops_on_model, recorded_transitions
from ctxval.learning.vector import predict_composed
from ctxval.models.corrected import before_refinement
from ctxval.searches import Prediction

_ResidualOf = Callable[[Rows], Step]
"""Rows of a batch of tasks -> the residual with which they are run."""

_CENTRES = (100, 450)
"""Least and largest number of transitions that the residual is conditioned on."""
_ROUGH_CENTRES = 64
"""The same for the rough prediction, with which a search screens many points."""
_DESIGNS = 2000
"""Number of designs for one suggestion, if the synthesizer takes batches."""
_SLOW_DESIGNS = 150
"""Number of designs for one suggestion, if the synthesizer takes one task at a time."""
_SLOW = 0.02
"""Seconds: if a single closed loop on M takes longer, closed loops are distributed over the cores."""


class DistancePredictor:
    """Predicts d at points that were not executed, from growing sets of executions of one campaign.

    What does not depend on the executions is kept between predictions: the controllers of tasks that are looked at
    again, and the trajectories of M there. It is forgotten if M or the synthesizer is changed in place, such as by
    fitting M again. Everything is a function of the executions, so a resumed campaign predicts the same.

    Args:
        validation: the map p -> d(p); S is never executed.
    """

    def __init__(self, validation: Validation) -> None:
        self.validation = validation
        self._forget()

    def _forget(self) -> None:
        self._plans = PlanMemory(self.validation)
        self._errors = ErrorVectors(self._plans)
        self._loops: tuple[Trajectory | None, float] | None = None
        self._learned: tuple[bytes, LearnedCovariance | None] | None = None
        self._parts: tuple[str, bytes] | None = None

    def _forget_if_changed(self) -> None:
        """Forget what is kept if the parts that it was made with are not what they were."""
        if self._loops is not None and self._parts != self._state_of_parts():
            self._forget()

    def _state_of_parts(self) -> tuple[str, bytes]:
        """Return the description of M and the synthesizer, and some steps of M, which a description may not show."""
        parts, loops = self.validation, self._loops_on_model()[0]
        steps = b""
        if loops is not None:
            middle = loops.horizon // 2
            steps = np.asarray(parts.model.step(loops.states[..., middle, :], loops.inputs[..., middle, :])).tobytes()
        return repr(describe([parts.model, parts.synthesizer])), steps

    def predict(self, executed: Executed) -> Prediction | None:
        """Return a prediction of d from executions and from the data that the model was made from.

        Returns None if there are no recorded transitions, if M already explains them, or if no task can be planned.

        If the distance is composed of a short vector, such as the error of the final state, a second prediction models
        the vector as a function of p, because an error that is no function of state and input may still be a function
        of p. The first prediction offers the second one as ``otherwise``. If there is no first prediction, the second
        one is returned instead.

        Args:
            executed: points of the unit cube ``(d,)`` with the system's trajectories there.
        """
        with single_threaded():
            self._forget_if_changed()
            otherwise = functools.partial(_predict_vectors, self._errors, executed)
            found = self._predict(executed)
            return otherwise() if found is None else replace(found, otherwise=otherwise)

    def _loops_on_model(self) -> tuple[Trajectory | None, float]:
        """Return closed loops on M, and the seconds that they took."""
        if self._loops is None:
            started = time.perf_counter()
            self._loops = closed_loops_on_model(self.validation), time.perf_counter() - started
            self._parts = self._state_of_parts()
        return self._loops

    def _predict(self, executed: Executed) -> Prediction | None:
        loops, seconds = self._loops_on_model()
        corrected = None if loops is None else self._corrected(executed, loops)
        if loops is None or corrected is None:
            return None
        batched = bool(loops.batch_shape)
        in_parallel = not batched and seconds > _SLOW
        exact = _PredictedDistance(self._plans, *corrected, executed, in_parallel)
        fewer = exact.residual.rough(_ROUGH_CENTRES)
        # If few centres do not suffice, both predictions are one, so that no task is predicted twice.
        rough = exact if fewer is exact.residual else replace(exact, residual=fewer)
        return Prediction(exact, exact.left_out, _DESIGNS if batched else _SLOW_DESIGNS, rough=rough)

    def _corrected(self, executed: Executed, loops: Trajectory) -> tuple[Model, Residual] | None:
        learned = self._covariance(executed[: _scheduled(len(executed))], loops)
        if learned is None or _scheduled(len(executed)) == len(executed):
            # If nothing could be learned when it was scheduled, it is learned now.
            learned = self._covariance(executed, loops)
            return None if learned is None else (learned.model, learned.residual)
        recorded = recorded_transitions(self.validation.model, [one for _, one in executed], loops)
        residual = None if recorded is None else learn_residual(learned, *recorded, _centres(loops))
        return None if residual is None else (learned.model, residual)

    def _covariance(self, executed: Executed, loops: Trajectory) -> LearnedCovariance | None:
        key = b"".join(part.tobytes() for _, one in executed for part in (one.states, one.inputs))
        if self._learned is None or self._learned[0] != key:
            recorded = recorded_transitions(self.validation.model, [one for _, one in executed], loops)
            model = before_refinement(self.validation.model)
            self._learned = key, None if recorded is None else learn_covariance(model, *recorded, _centres(loops))
        return self._learned[1]

    def __repr__(self) -> str:
        return call(self, self.validation)


def predict_distance(validation: Validation, executed: Executed) -> Prediction | None:
    """Return a single prediction of d; see :meth:`DistancePredictor.predict`.

    Args:
        validation: the map p -> d(p).
        executed: points of the unit cube ``(d,)`` with the system's trajectories there.
    """
    return DistancePredictor(validation).predict(executed)


def _centres(loops: Trajectory) -> int:
    """Return the largest number of transitions that the residual is conditioned on."""
    return affordable_centres(loops.horizon, *_CENTRES)


def _scheduled(count: int) -> int:
    """Return the largest number of executions, up to ``count``, at which hyperparameters are learned.

    These are 0 to 4, 6, 8, 12, 16, 24 and so on, two in each doubling.
    """
    step = 1
    while count >= 4 * step:
        step *= 2
    return count - count % step


def _predict_vectors(errors: ErrorVectors, executed: Executed) -> Prediction | None:
    """Return the prediction from the vectors of which distances are composed; None if they are not known."""
    distance, vectors = errors.validation.distance, errors.of(executed)
    if vectors is None or not isinstance(distance, ComposedDistance):
        return None
    return predict_composed(np.array([point for point, _ in executed]), vectors, distance.compose)


@dataclass(frozen=True, eq=False)
class _PredictedDistance:
    """The validation of M against M_hat, as a function of points of the unit cube.

    Attributes:
        plans: designs controllers, and keeps the latest ones.
        model, residual: the corrected model M_hat is their sum.
        executed: executed points, with the trajectories from which M_hat was learned.
        in_parallel: whether closed loops are distributed over the cores; their results are the same.
    """

    plans: PlanMemory
    model: Model
    residual: Residual
    executed: Executed
    in_parallel: bool

    _known: dict[bytes, tuple[float, float]] = field(default_factory=dict, init=False)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Return the predicted distances ``(m,)``, and the doubt in the predicted trajectories ``(m,)``."""
        keys = [point.tobytes() for point in points]
        new = [row for row, key in enumerate(keys) if key not in self._known]
        if new:
            with single_threaded():
                found = self._predicted(points[new])
            self._known.update(
                zip((keys[row] for row in new), zip(*map(np.ndarray.tolist, found), strict=True), strict=True)
            )
        distance, doubt = np.array([self._known[key] for key in keys]).reshape(-1, 2).T
        return distance, doubt

    def _predicted(self, points: Array) -> tuple[Array, Array]:
        if not self.in_parallel or all(map(self.plans.has, points)):
            return self._looped(points, lambda rows: self.residual)
        parts = on_all_cores(lambda point: self._looped(point, lambda rows: self.residual), list(points[:, None, :]))
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def left_out(self, rows: Rows) -> Array:
        """Return the distances predicted at executed points, each from the executions of other points, ``(k,)``."""
        points = np.array([self.executed[k][0] for k in rows.tolist()])
        without = self.residual.without(executions_of(self.executed, points))
        with single_threaded():
            return self._looped(points, lambda rows: without[rows])[0]

    def _looped(self, points: Array, residual: _ResidualOf) -> tuple[Array, Array]:
        """Return distances and doubts ``(m,)``; NaN for a task that fails. A batch that fails is halved and retried."""
        distance, doubt = np.full(len(points), np.nan), np.full(len(points), np.nan)
        for planned in self.plans.plan(points):
            rows = planned.rows
            try:
                distance[rows], doubt[rows] = self._closed_loops(planned, residual(rows))
            except Exception:  # the user's controller, on states that may never be reached
                for half in np.array_split(rows, 2) if len(rows) > 1 else []:
                    distance[half], doubt[half] = self._looped(points[half], functools.partial(_of, residual, half))
        return distance, doubt

    def _closed_loops(self, planned: PlannedTasks, residual: Step) -> tuple[Array, Array]:
        predicted = rollout(CorrectedModel(self.model, residual).step, planned.controller, planned.task)
        distance = self.plans.planner.measured(planned.task, planned.promised, predicted)
        doubt = self.residual.unfamiliarity(predicted)
        finite = np.isfinite(distance) & np.isfinite(doubt) & planned.promised.finite & predicted.finite
        return np.where(finite, distance, np.nan), np.where(finite, doubt, np.nan)


def _of(residual: _ResidualOf, chosen: Rows, rows: Rows) -> Step:
    """Return the residual for some of the chosen rows."""
    return residual(chosen[rows])
