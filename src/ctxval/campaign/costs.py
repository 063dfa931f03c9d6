"""What an execution of the system and the prediction of a task cost, in seconds."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence

import numpy as np

from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.searches import Costs, Prediction

_BATCHES = (1, 8, 64)
"""Numbers of tasks that are predicted at once to measure the cost of one; the first is also a warm-up."""

_ENOUGH = 0.1
"""Seconds: a batch that takes longer needs no larger one after it."""


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
    """Return the seconds in which one task is predicted, in a batch if there can be one."""
    rng, seconds = np.random.default_rng(0), math.inf
    for count in _BATCHES:
        points = rng.random((count, dimension))
        started = time.perf_counter()
        prediction.expected(points)
        taken = time.perf_counter() - started
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
