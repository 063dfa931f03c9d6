"""Predictions beside the executions that they predicted: which held, which were tests, and which failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ctxval._util.representation import ShortRepr
from ctxval.certificates.limits import LIMITS, CheckLimits
from ctxval.certificates.prediction_tests import DRAWN
from ctxval.core.quantiles import LEVELS, chance_of_more
from ctxval.core.trial import Origin


@dataclass(frozen=True)
class CheckedPrediction(ShortRepr):
    """A prediction from earlier executions only, compared with the execution."""

    trial: int  #: the number of the trial
    rank: float  #: share of the predicted distances that are below the executed one; NaN if nothing was predicted
    median: float  #: median of the predicted distances; infinity if nothing was predicted
    upper: float  #: 0.95 quantile of the predicted distances; infinity if more draws than that diverged
    distance: float  #: the executed distance
    z2: float = np.nan  #: squared standardised error, the larger one of trajectory and distance; NaN if it is not known
    stored: bool = True  #: whether the prediction was stored before the execution; if not, it was computed afterwards
    new: bool = True  #: whether the task differs from those that were executed before
    origin: Origin = "acquisition"  #: the reason why the task was chosen
    point: tuple[float, ...] = ()  #: the task, a point of the unit cube ``(d,)``
    quantiles: tuple[float, ...] = ()  #: those of the predicted distances at ``quantiles.LEVELS``; empty without noise
    runs: int = 0  #: the number of predicted distances that these are of
    p_values: tuple[float, ...] = ()  #: chances of more than statistics of the trajectory; empty without noise
    explained: float | None = None  #: the distance of the task on what all executions teach; None if it is not known
    negligible: float = 0.0  #: the largest difference from the prediction by errors of M that are not learned

    @property
    def is_noisy(self) -> bool:
        """Whether it predicts what noise does."""
        return len(self.quantiles) > 0

    @property
    def is_test(self) -> bool:
        """Whether it was stored before the execution of a task that was drawn as a test."""
        return self.stored and self.origin in DRAWN

    def chance_of_more(self, distance: float) -> float:
        """Return the predicted probability that an execution exceeds a distance; it is never 0."""
        return chance_of_more(self.quantiles, distance, self.runs)

    @property
    def excess(self) -> float:
        """How far the distance exceeds the median, or the 0.9 quantile with noise; infinity without a prediction."""
        if self.is_noisy:
            return max(self.distance - float(np.interp(0.9, LEVELS, self.quantiles)), 0.0)
        return max(self.distance - self.median - self.negligible, 0.0) if np.isfinite(self.median) else np.inf

    @property
    def error(self) -> float:
        """The difference between distance and median that is not negligible; infinity if nothing was predicted."""
        return max(abs(self.distance - self.median) - self.negligible, 0.0) if np.isfinite(self.median) else np.inf

    def held(self, bound: float, limits: CheckLimits = LIMITS) -> bool:
        """Return whether the execution agrees with it; with noise, whether it is not improbably large."""
        if self.is_noisy:
            return self.chance_of_more(self.distance - limits.tolerated * bound) >= limits.unlikely
        return self.error <= limits.error * bound

    def to_json(self) -> dict[str, Any]:
        """Return all attributes but the quantiles, ready for JSON: numbers that are not finite are None."""
        plain = {name: value for name, value in asdict(self).items() if name not in ("quantiles", "runs")}
        unknown = [name for name, value in plain.items() if isinstance(value, float) and not np.isfinite(value)]
        return {**plain, **dict.fromkeys(unknown)}


def agrees(distance: float, predicted: float, bound: float, limits: CheckLimits = LIMITS) -> bool:
    """Return whether a distance agrees with the median of its prediction, as far as it matters for a bound.

    A vague prediction that covers the distance does not suffice: hidden states make predictions vague.
    """
    return abs(distance - predicted) <= limits.error * bound


def mostly_fail(holding: Sequence[bool], limits: CheckLimits = LIMITS) -> bool:
    """Return whether predictions fail so often that the dynamics cannot be learned, by which of all of them held."""
    last = holding[-limits.failing :]
    return len(last) == limits.failing and 2 * sum(last) < limits.failing


def missing_tests(predictions: Sequence[CheckedPrediction], tests: int, limits: CheckLimits = LIMITS) -> int:
    """Return the number of executions that complete the tests; those that were predicted beforehand count.

    A noisy prediction that expects far more than what was ever executed could not have failed, and is no test.
    """
    largest = max((each.distance for each in predictions), default=0.0)
    drawn = [each for each in predictions if each.is_test]
    return max(tests - sum(not (each.is_noisy and each.upper > limits.vague * largest) for each in drawn), 0)


def latest_tests(predictions: Sequence[CheckedPrediction], tests: int) -> list[CheckedPrediction]:
    """Return the predictions at drawn tasks among the latest that complete the tests; among all if none do."""
    stored = [prediction for prediction in predictions if prediction.stored and prediction.point]
    first = range(len(stored) - 1, -1, -1) if tests else ()
    latest = next((stored[k:] for k in first if not missing_tests(stored[k:], tests)), stored if tests else [])
    return [test for test in latest if test.origin in DRAWN]
