"""What an execution of the system and the prediction of a task cost, in seconds."""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.plan import Plan
from ctxval.core.rollout import rollout
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.learning.prediction import predict_distance
from ctxval.searches import Auto, Costs, Prediction
from ctxval.searches.auto import FAST

_BATCHES = (1, 8, 64)
"""Numbers of tasks that are predicted at once to measure the cost of one; the first is also a warm-up."""

_ENOUGH = 0.1
"""Seconds: a batch that takes longer needs no larger one after it."""


@dataclass(frozen=True)
class ThinkingCosts:
    """What the search ``auto`` costs before the first execution of S, in seconds of CPU time.

    Attributes:
        design: seconds of the design of one controller.
        closed_loop: seconds of one closed loop on the model.
        suggestion: estimated seconds of one suggestion; None if it cannot be estimated.
        designs: number of designs of this suggestion; None likewise.
        fast: estimated seconds of one suggestion with the thinking ``"fast"``; None likewise.
    """

    design: float
    closed_loop: float
    suggestion: float | None = None
    designs: int | None = None
    fast: float | None = None

    @classmethod
    def measured(cls, validation: Validation, points: Sequence[Array]) -> ThinkingCosts:
        """Measure the costs. S is not executed: made-up trajectories that differ from those of M take its place.

        Args:
            validation: the map p -> d(p).
            points: tasks of these executions, each ``(d,)``.

        Raises:
            ModelError, DesignError: if a task cannot be planned.
        """
        parts, task = validation, validation.task(validation.space.parameters(points[0]))
        design = _cpu_seconds(lambda: parts.synthesizer.design(task, parts.model))
        controller = parts.synthesizer.design(task, parts.model)
        loop = _cpu_seconds(lambda: rollout(parts.model.step, controller, task))
        made_up = [(validation.space.to_unit(point), _unlike(validation.plan(point))) for point in points]
        begun = _cpu_now()
        prediction = predict_distance(validation, made_up)
        if prediction is None:
            return cls(design, loop)
        learning = _cpu_now() - begun
        each = _seconds_of_prediction(prediction, validation.space.dimension)
        search = Auto("thorough")
        search.reset(validation.space.dimension, 0)
        designs = search.designs(prediction)
        fast = round(FAST * designs)
        return cls(design, loop, learning + designs * each, designs, learning + fast * each)


def _unlike(plan: Plan) -> Trajectory:
    """Return a trajectory that differs from that of M by a tenth of the range of each state."""
    promised = plan.model_trajectory
    away = 0.1 * np.ptp(promised.states, axis=0) * np.sin(np.linspace(0, 3, promised.horizon + 1))[:, None]
    return replace(promised, states=promised.states + away)


def _cpu_seconds(work: Callable[[], object]) -> float:
    """Return the seconds of CPU time of some work, as the least of three times."""
    found = []
    for _ in range(3):
        begun = _cpu_now()
        work()
        found.append(_cpu_now() - begun)
    return min(found)


def _cpu_now() -> float:
    """Return the seconds of CPU time of this process and of its child processes that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def costs_of(prediction: Prediction, validation: Validation, trials: Sequence[Trial]) -> Costs:
    """Return the costs that decide how long a search thinks.

    Args:
        prediction: the prediction of a task, which is timed. It designs a controller and runs two closed loops.
        validation: contains the system. If people execute it, an execution costs more than all thinking.
        trials: the trials, which contain the seconds of their executions.
    """
    predicting = _seconds_of_prediction(prediction, validation.space.dimension)
    return Costs(predicting, _seconds_of_execution(validation, trials))


def _seconds_of_prediction(prediction: Prediction, dimension: int) -> float:
    """Return the seconds of CPU time in which one task is predicted, in a batch if there can be one."""
    # Elapsed time would make the choices depend on what else the machine does.
    rng, seconds = np.random.default_rng(0), math.inf
    for count in _BATCHES:
        points = rng.random((count, dimension))
        started = _cpu_now()
        prediction.expected(points)
        taken = _cpu_now() - started
        seconds = min(seconds, taken / count)
        if taken > _ENOUGH:
            break
    return seconds


def _seconds_of_execution(validation: Validation, trials: Sequence[Trial]) -> float | None:
    """Return the median of the seconds of executions; None if none was timed."""
    if getattr(validation.system, "manual", False):
        return math.inf
    timed = [trial.seconds for trial in trials if trial.executed and trial.seconds is not None]
    return statistics.median(timed) if timed else None
