"""Executed tasks on the corrected model: what the executions of the other tasks predict for each of them.

Each task is replayed on the corrected model ``M_hat = M + r``, where r is learned without the executions of that task.
The controller is the one that is designed on M, so the replay answers whether the recorded dynamics explain what the
system did. The system is never executed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.progress import advance
from ctxval._util.representation import call
from ctxval.core.model import Model
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.dynamics import Residual, ResidualsWithout, learn_covariance
from ctxval.learning.error_vectors import Executed, executions_of
from ctxval.learning.recorded import affordable_centres, closed_loops_on_model, recorded_transitions
from ctxval.models.corrected import before_refinement

_CENTRES = (100, 300)
"""Least and largest number of transitions that the residual is conditioned on."""


@dataclass(frozen=True, eq=False)
class Replay:
    """One executed task on M, and on the corrected model that is learned from all other tasks.

    Attributes:
        task: the task.
        corrected: the closed loop on the corrected model; None if nothing can be learned, or if it diverges.
        distance: the distance between the closed loops on M and on the corrected model; NaN if there is none.
    """

    task: Task
    corrected: Trajectory | None
    distance: float

    def __repr__(self) -> str:
        return call(self, self.task, distance=self.distance)


def replay_executed(validation: Validation, executed: Executed, wanted: Sequence[Array]) -> list[Replay | None]:
    """Return the replays of tasks; None for a task that cannot be planned.

    Args:
        validation: the map p -> d(p); S is never executed.
        executed: points of the unit cube ``(d,)`` with the system's trajectories there; the dynamics are learned from
            all of them, except those at the task that is replayed.
        wanted: points of the unit cube ``(d,)`` of the tasks.
    """
    with single_threaded():
        corrected = _corrected(validation, executed)
        if corrected is None:
            return [_replayed(validation, None, point) for point in wanted]
        without = corrected[1].without(executions_of(executed, wanted))
        rows = np.arange(len(wanted))
        models = [_OneCorrected(corrected[0], without[rows[k : k + 1]]) for k in range(len(wanted))]
        return [_replayed(validation, model, point) for model, point in zip(models, wanted, strict=True)]


def _corrected(validation: Validation, executed: Executed) -> tuple[Model, Residual] | None:
    """Return the corrected model from all executions; None if nothing can be learned."""
    try:
        loops = closed_loops_on_model(validation)
        if loops is None:
            return None
        recorded = recorded_transitions(validation.model, [trajectory for _, trajectory in executed], loops)
        centres = affordable_centres(loops.horizon, *_CENTRES)
        model = before_refinement(validation.model)
        learned = None if recorded is None else learn_covariance(model, *recorded, centres)
        return None if learned is None else (learned.model, learned.residual)
    except Exception:  # the user's own parts, at states that no execution has reached
        return None


@dataclass(frozen=True)
class _OneCorrected:
    """The corrected model of one task.

    Attributes:
        model: the model to which the residual is added.
        residual: the residual that does not know the executions of this task, as a batch of one.
    """

    model: Model
    residual: ResidualsWithout

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(n,), (m,) -> (n,)``."""
        return np.asarray(self.model.step(x, u) + self.residual(x[None], u[None])[0])


def _replayed(validation: Validation, model: _OneCorrected | None, point: Array) -> Replay | None:
    advance()
    space = validation.space
    try:
        task = validation.task(space.parameters(space.from_unit(point)))
        controller = validation.synthesizer.design(task, validation.model)
    except Exception:  # the user's own parts
        return None
    nothing = Replay(task, None, np.nan)
    if model is None:
        return nothing
    try:
        promised = rollout(validation.model.step, controller, task)
        predicted = rollout(model.step, controller, task)
        with np.errstate(all="ignore"):
            # Some distances change the arrays that they are given.
            distance = float(validation.distance(promised, predicted.copy(), task))
    except Exception:  # the same
        return nothing
    finite = bool(predicted.finite.all()) and np.isfinite(distance)
    return Replay(task, predicted, distance) if finite else nothing
