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
from ctxval._util.representation import call
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.dynamics import CorrectedModel, learn_corrected
from ctxval.learning.recorded import closed_loops_on_model, recorded_transitions

_CENTRES = (100, 300)
"""Least and largest number of transitions that the residual is conditioned on."""
_WORK = 30_000
"""Number of these transitions times the horizon; it bounds the time of a closed loop."""


@dataclass(frozen=True, eq=False)
class Replay:
    """One executed task on M, and on the corrected model that is learned from all other tasks.

    Attributes:
        task: the task.
        corrected: the closed loop on the corrected model; None if nothing can be learned, or if it diverges.
        distance: the distance between the closed loops on M and on the corrected model; NaN if there is none.
        converged: whether the design of the controller converged; None if the synthesizer does not tell.
    """

    task: Task
    corrected: Trajectory | None
    distance: float
    converged: bool | None

    def __repr__(self) -> str:
        return call(self, self.task, distance=self.distance, converged=self.converged)


def replay_executed(
    validation: Validation, executed: Sequence[tuple[Array, Trajectory]], wanted: Sequence[Array]
) -> list[Replay | None]:
    """Return the replays of tasks; None for a task that cannot be planned.

    Args:
        validation: the map p -> d(p); S is never executed.
        executed: points of the unit cube ``(d,)`` with the system's trajectories there; the dynamics are learned from
            all of them, except those at the task that is replayed.
        wanted: points of the unit cube ``(d,)`` of the tasks.
    """
    with single_threaded():
        corrected = _corrected(validation, executed)
        return [_replayed(validation, corrected, [one for one, _ in executed], point) for point in wanted]


def _corrected(validation: Validation, executed: Sequence[tuple[Array, Trajectory]]) -> CorrectedModel | None:
    """Return the corrected model from all executions; None if nothing can be learned."""
    try:
        loops = closed_loops_on_model(validation)
        if loops is None:
            return None
        recorded = recorded_transitions(validation.model, [trajectory for _, trajectory in executed], loops)
        if recorded is None:
            return None
        return learn_corrected(validation.model, *recorded, int(np.clip(_WORK // loops.horizon, *_CENTRES)))
    except Exception:  # the user's own parts, at states that no execution has reached
        return None


def _replayed(
    validation: Validation, corrected: CorrectedModel | None, executed: Sequence[Array], point: Array
) -> Replay | None:
    space = validation.space
    try:
        task = validation.task(space.parameters(space.from_unit(point)))
        controller, converged = _designed(validation, task)
    except Exception:  # the user's own parts
        return None
    nothing = Replay(task, None, np.nan, converged)
    if corrected is None:
        return nothing
    there = [source for source, other in enumerate(executed) if np.array_equal(other, point)]
    model = CorrectedModel(corrected.model, corrected.residual.without(there))
    try:
        promised = rollout(validation.model.step, controller, task)
        predicted = rollout(model.step, controller, task)
        with np.errstate(all="ignore"):
            distance = float(validation.distance(promised, predicted, task))
    except Exception:  # the same
        return nothing
    finite = bool(predicted.finite.all()) and np.isfinite(distance)
    return Replay(task, predicted, distance, converged) if finite else nothing


def _designed(validation: Validation, task: Task) -> tuple[Controller, bool | None]:
    """Return the controller of a task, and whether its design converged, if the synthesizer tells."""
    solve = getattr(validation.synthesizer, "solve", None)
    if callable(solve):
        solution = solve(task, validation.model)
        controller, converged = getattr(solution, "controller", None), getattr(solution, "converged", None)
        if callable(controller) and converged is not None:
            return controller, bool(np.all(converged))
    return validation.synthesizer.design(task, validation.model), None
