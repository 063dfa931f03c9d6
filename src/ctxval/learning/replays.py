"""Executed tasks on the corrected model: what the executions of the other tasks predict for each of them.

The controller is the one that is designed on M, so a replay answers whether the recorded dynamics explain what the
system did. The system is never executed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.progress import advance
from ctxval._util.representation import ShortRepr
from ctxval.core.model import run_of
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.draws import DynamicsDraws
from ctxval.learning.dynamics_study import DynamicsStudy
from ctxval.learning.learned_dynamics import LearnedDynamics
from ctxval.learning.prediction import executions_of


@dataclass(frozen=True, eq=False)
class Replay(ShortRepr):
    """One executed task on M, and on the corrected model that is learned from all other tasks."""

    task: Task
    # the closed loop on the corrected model; None if nothing can be learned, or if it diverges
    corrected: Trajectory | None
    distance: float  # the distance between the closed loops on M and on the corrected model; NaN if there is none


def replay_executed(
    validation: Validation, learned: LearnedDynamics | None, wanted: Sequence[Array]
) -> list[Replay | None]:
    """Return the replays of tasks ``(d,)``, each without its own executions; None for one that cannot be planned."""
    models: list[DynamicsDraws | None] = [None] * len(wanted)
    study = DynamicsStudy(validation) if learned is None else learned.study
    with single_threaded():
        if learned is not None:
            with contextlib.suppress(Exception):  # the user's own parts, at states that no execution has reached
                without = learned.posterior.means_without(executions_of(learned.executed, wanted))
                models = [without[k] for k in range(len(wanted))]
        return [_replayed(study, model, point) for model, point in zip(models, wanted, strict=True)]


def _replayed(study: DynamicsStudy, model: DynamicsDraws | None, point: Array) -> Replay | None:
    advance()
    validation, space = study.validation, study.validation.space
    try:
        parameters = space.parameters(space.from_unit(point))
        plain, task = study.given.task_at(parameters), validation.task_at(parameters)
        controller = validation.synthesizer.design(task, validation.model)
    except Exception:  # the user's own parts
        return None
    nothing = Replay(plain, None, np.nan)
    if model is None:
        return nothing
    try:
        nominal = validation.closed_loop(controller, task)
        step = study.planner.with_effects(run_of(model, task.initial_state))
        predicted = rollout(step, controller, task)
        distance = float(validation.distance_between(nominal, predicted, task))
    except Exception:  # the same
        return nothing
    finite = bool(predicted.finite.all()) and np.isfinite(distance)
    return Replay(plain, study.extended.recorded(predicted), distance) if finite else nothing
