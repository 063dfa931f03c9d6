"""What an execution of the system and the prediction of a task cost, in seconds of CPU time.

Elapsed time would depend on what else the machine does.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval import learning
from ctxval._util.arrays import Array
from ctxval._util.progress import stage
from ctxval.certificates.dynamics import draws_for
from ctxval.certificates.options import CONFIDENCE
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.searches import Auto, Costs, Prediction


@dataclass(frozen=True)
class ThinkingCosts:
    """What the choice of a task costs after a few executions of S; None if it cannot be estimated."""

    design: float  #: seconds of the design of one controller
    closed_loop: float  #: seconds of one closed loop on the model
    choice: float | None = None  #: estimated seconds of the choice of a task that decides
    verdict: float | None = None  #: estimated seconds of the bound that decides
    suggestion: float | None = None  #: estimated seconds of one suggestion of the search ``auto``
    designs: int | None = None  #: number of designs of this suggestion
    fast: float | None = None  #: estimated seconds of one suggestion with the thinking ``"fast"``

    @classmethod
    def measured(cls, validation: Validation, points: Sequence[Array]) -> ThinkingCosts:
        """Measure the costs at tasks, each ``(d,)``; made-up trajectories take the place of executions of S."""
        model, task = validation.model, validation.task_at(validation.space.parameters(points[0]))
        controller = validation.synthesizer.design(task, model)
        design = min(_seconds(lambda: validation.synthesizer.design(task, model)) for _ in range(3))
        loop = min(_seconds(lambda: validation.closed_loop(controller, task)) for _ in range(3))
        made_up = []
        for point in points:  # trajectories that differ from those of M by a tenth of the range of each state
            nominal = validation.plan(point).model_trajectory
            away = 0.1 * np.ptp(nominal.states, axis=0) * np.sin(np.linspace(0, 3, nominal.horizon + 1))[:, None]
            made_up.append((validation.space.to_unit(point), replace(nominal, states=nominal.states + away)))
        begun, study = _now(), learning.DynamicsStudy(validation)
        learned = study.learn(made_up)
        prediction = study.prediction_of(learned, made_up)
        if prediction is None:
            return cls(design, loop)
        to_learn = _now() - begun
        costs = costs_of(prediction, validation, ())
        choice = verdict = None
        if learned is not None:
            designing = study.search.settings.pool * (costs.rough or costs.prediction)
            loops, each = study.search.screening_loops, costs.prediction
            if designing < 5:  # then the screening itself is timed
                begun = _now()
                learned.screened  # noqa: B018 (what is computed first takes long)
                each = (_now() - begun) / loops
            choice = to_learn + max(designing, loops * each)
            verdict = choice + study.search.expected_loops(draws_for(CONFIDENCE)) * each
        search = Auto("thorough")
        search.reset(validation.space.dimension, 0)
        designs = search.designs(prediction)
        fewest = round(search.settings.shares[-1] * designs)
        thorough, fast = (search.thinking_seconds(costs, number) for number in (designs, fewest))
        return cls(design, loop, choice, verdict, to_learn + thorough, designs, to_learn + fast)


def costs_of(prediction: Prediction, validation: Validation, trials: Sequence[Trial]) -> Costs:
    """Return the costs that decide how long a search thinks."""
    dimension, rng = validation.space.dimension, np.random.default_rng(0)
    batched = bool(getattr(validation.synthesizer, "batched", False))
    predict = prediction.rough or prediction.expected
    with stage("timing predictions", unit="designs"):
        first = rng.random((1, dimension))
        single = _seconds(lambda: predict(first))
        count = 64 if batched and single <= 0.02 else 8 if batched or single <= 0.1 else 1
        points = rng.random((count, dimension))
        seconds = _seconds(lambda: predict(points))
        # What a batch costs besides its points follows from a batch of one point.
        each = seconds if count == 1 else min(max(seconds - single, 0.0) / (count - 1), seconds / count)
        # The controllers of these points are known now, so the exact prediction adds what its closed loops cost.
        more = _seconds(lambda: prediction.expected(points)) / count
    timed = [trial.seconds for trial in trials if trial.executed and trial.seconds is not None]
    execution = statistics.median(timed) if timed else None
    if getattr(validation.system, "manual", False):
        execution = math.inf
    return Costs(each + more, execution, each, seconds - count * each)


def _seconds(work: Callable[[], object]) -> float:
    begun = _now()
    work()
    return _now() - begun


def _now() -> float:
    """Return the seconds of CPU time of this process and of its child processes that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system
