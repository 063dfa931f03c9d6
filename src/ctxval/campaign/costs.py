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
from ctxval._util.progress import stage
from ctxval.certificates.dynamics import draws_for
from ctxval.certificates.options import CONFIDENCE
from ctxval.core.plan import Plan
from ctxval.core.rollout import rollout
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.learning import DynamicsStudy
from ctxval.searches import Auto, Costs, Prediction
from ctxval.searches.auto import FAST

_BATCHES = (1, 8, 64)
"""Numbers of tasks that may be predicted at once to measure what a task costs, and a batch besides its tasks."""

_QUICK, _ENOUGH = 0.02, 0.1
"""Seconds of a single prediction up to which the large batch is timed if designs take batches, and up to which the
medium one is timed if they do not."""

_SCREENED = 5.0
"""Seconds of the designs of a screening up to which it is timed."""


@dataclass(frozen=True)
class ThinkingCosts:
    """What the choice of a task costs after a few executions of S, in seconds of CPU time.

    Attributes:
        design: seconds of the design of one controller.
        closed_loop: seconds of one closed loop on the model.
        choice: estimated seconds of the choice of a task that decides; None if it cannot be estimated.
        verdict: estimated seconds of the bound that decides; None likewise.
        suggestion: estimated seconds of one suggestion of the search ``auto``; None likewise.
        designs: number of designs of this suggestion; None likewise.
        fast: estimated seconds of one suggestion with the thinking ``"fast"``; None likewise.
    """

    design: float
    closed_loop: float
    choice: float | None = None
    verdict: float | None = None
    suggestion: float | None = None
    designs: int | None = None
    fast: float | None = None

    @classmethod
    def measured(cls, validation: Validation, points: Sequence[Array]) -> ThinkingCosts:
        """Measure the costs. S is not executed: made-up trajectories that differ from those of M take its place.

        Args:
            validation: the map p -> d(p).
            points: tasks of these executions, each ``(d,)``.
        """
        parts, task = validation, validation.task(validation.space.parameters(points[0]))
        design = _cpu_seconds(lambda: parts.synthesizer.design(task, parts.model))
        controller = parts.synthesizer.design(task, parts.model)
        loop = _cpu_seconds(lambda: rollout(parts.model.step, controller, task))
        made_up = [(validation.space.to_unit(point), _unlike(validation.plan(point))) for point in points]
        begun, study = _cpu_now(), DynamicsStudy(validation)
        learned = study.learn(made_up)
        prediction = study.prediction_of(learned, made_up)
        if prediction is None:
            return cls(design, loop)
        learning = _cpu_now() - begun
        costs = costs_of(prediction, validation, ())
        choice = verdict = None
        if learned is not None:
            designing = study.search.settings.pool * (costs.rough or costs.prediction)
            loops, each = study.search.screening_loops, costs.prediction
            if designing < _SCREENED:
                begun = _cpu_now()
                learned.screened  # noqa: B018 (what is computed first takes long)
                each = (_cpu_now() - begun) / loops
            choice = learning + max(designing, loops * each)
            verdict = choice + study.search.expected_loops(draws_for(CONFIDENCE)) * each
        search = Auto("thorough")
        search.reset(validation.space.dimension, 0)
        designs = search.designs(prediction)
        thorough, fast = (search.thinking_seconds(costs, number) for number in (designs, round(FAST * designs)))
        return cls(design, loop, choice, verdict, learning + thorough, designs, learning + fast)


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
    """Return the costs that decide how long a search thinks."""
    batched = bool(getattr(validation.synthesizer, "batched", False))
    with stage("timing predictions", unit="designs"):
        each, batch, more = _measured(prediction, validation.space.dimension, batched)
    return Costs(each + more, _seconds_of_execution(validation, trials), each, batch)


def _measured(prediction: Prediction, dimension: int, batched: bool) -> tuple[float, float, float]:
    """Return the seconds of a rough prediction, of a batch besides its points, and what an exact prediction adds."""
    predict, rng = prediction.rough or prediction.expected, np.random.default_rng(0)
    single = _predicting_seconds(predict, rng.random((1, dimension)))
    small, medium, large = _BATCHES
    timed = large if batched and single <= _QUICK else medium if batched or single <= _ENOUGH else small
    points = rng.random((timed, dimension))
    seconds, count = _predicting_seconds(predict, points), len(points)
    # What a batch costs besides its points follows from a batch of one point.
    each = seconds if count == 1 else min(max(seconds - single, 0.0) / (count - 1), seconds / count)
    # The controllers of these points are known now, so the exact prediction adds what its closed loops cost.
    return each, seconds - count * each, _predicting_seconds(prediction.expected, points) / count


def _predicting_seconds(predict: Callable[[Array], object], points: Array) -> float:
    """Return the seconds of CPU time of a prediction; elapsed time would depend on what else the machine does."""
    started = _cpu_now()
    predict(points)
    return _cpu_now() - started


def _seconds_of_execution(validation: Validation, trials: Sequence[Trial]) -> float | None:
    """Return the median of the seconds of executions; None if none was timed."""
    if getattr(validation.system, "manual", False):
        return math.inf
    timed = [trial.seconds for trial in trials if trial.executed and trial.seconds is not None]
    return statistics.median(timed) if timed else None
