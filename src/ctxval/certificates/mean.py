"""The expected distance over the distribution of tasks, and a quantile of it, from independent draws.

The prediction of the distance is a control variate: it is fixed before the draws, so what is known of it at other tasks
lowers the variance of the estimate and never makes it wrong. See :mod:`ctxval.certificates.intervals`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import Must, PositiveFloat, Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import ONE_CAMPAIGN, Certificate, CertificateKind
from ctxval.certificates.bounds import at_least, at_most
from ctxval.certificates.draws import countable_draws, how_drawn, not_counted
from ctxval.certificates.intervals import Interval, asymptotic_interval, betting_interval, quantile_ranks
from ctxval.certificates.learned import LearnedDistance, require_learned
from ctxval.certificates.region import FROZEN
from ctxval.certificates.sample import Sample, advice_to_remeasure
from ctxval.certificates.scenario import UNSEEN, violations
from ctxval.errors import CertificateError

_FEWEST = 10
"""Least number of draws of an asymptotic interval: below it, the normal approximation is not trusted at all."""


@part("mean")
@dataclass(frozen=True, repr=False)
class Mean(CertificateKind):
    """Confidence interval of the expected distance, with the prediction as control variate; it never bounds d*.

    Attributes:
        quantile: level of a quantile of the distance that is stated as well, such as 0.9; None if none is. The
            statement on it is exact; the probability of an error is then divided between the two statements.
        largest_possible: a number that no distance can exceed, if one is known, in the distance's units; the interval
            is then valid for any number of draws. Without it, the interval is asymptotic.
        predictions: number M of tasks at which the prediction is averaged.
    """

    name: ClassVar[str] = "mean"
    bounds_maximum: ClassVar[bool] = False
    needs_model: ClassVar[bool] = True
    never_validates: ClassVar[str] = (
        "the mean certificate is about the expected distance; it says nothing of the largest one, so it validates no "
        "threshold"
    )

    quantile: Probability | None = None
    largest_possible: PositiveFloat | None = None
    predictions: Annotated[int, Must("an integer of at least 2", lambda value: value >= 2)] = 2000

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_mean` of the trials."""
        return certify_mean(sample, confidence, self)


@dataclass(frozen=True, eq=False)
class _Draws:
    """Independent draws with their predictions, and the predictions of other tasks.

    Attributes:
        counted: the draws that count.
        before: number of the first of them.
        values: their distances, shape ``(N,)``; of failed ones the largest possible distance.
        predicted: what was predicted for them, ``(N,)``.
        elsewhere: predictions of M other independent tasks, ``(M,)``.
        unpredicted: number of draws whose distance cannot be predicted.
    """

    counted: Sample
    before: int
    values: Array
    predicted: Array
    elsewhere: Array
    unpredicted: int


@checked
def certify_mean(sample: Sample, confidence: Probability = 0.95, options: Mean | None = None) -> Certificate:
    """Return a two-sided confidence interval of the expected distance, and of a quantile if one is asked for.

    Args:
        sample: trials of any origin, some of them independent draws, with what the experiment's model predicts.
        confidence: 1 - beta, the probability with which all of the statement holds.
        options: the quantile, a largest possible distance and the number of predicted tasks.

    Raises:
        CertificateError: if the experiment is not loaded, there are too few independent draws, their number depended
            on their distances, or a draw failed and no largest possible distance is stated.
    """
    chosen = options or Mean()
    beta = 1 - confidence
    draws = _draws_of(sample, require_learned(sample, "mean"), chosen)
    own = beta if chosen.quantile is None else beta / 2
    if chosen.largest_possible is None:
        interval = asymptotic_interval(draws.values, draws.predicted, draws.elsewhere, own)
    else:
        interval = betting_interval(draws.values, draws.predicted, draws.elsewhere, chosen.largest_possible, own)
    limits = (None, None) if chosen.quantile is None else _quantile_limits(draws.counted, chosen.quantile, own)
    return Certificate(
        kind="mean",
        statement=_statement(sample, draws, interval, limits, confidence, chosen),
        upper_bound=float("inf"),
        confidence=confidence,
        volume=1.0,
        trials=len(draws.values),
        assumptions=_assumptions(sample, draws, chosen),
        details=_details(sample, draws, interval, limits, chosen),
        distribution=sample.distribution,
    )


def _draws_of(sample: Sample, learned: LearnedDistance, options: Mean) -> _Draws:
    """Return the draws; a task that cannot be predicted gets the mean of the earlier distances as its prediction."""
    counted, most = countable_draws(sample, "a mean certificate"), options.largest_possible
    _require_usable(sample, counted, most)
    before = min(counted.numbers)
    predicted = learned.expected(counted.points, before)
    elsewhere = learned.expected(learned.tasks(options.predictions, before), before)
    earlier = sample.distances[np.array(sample.numbers) < before]
    known = earlier[~np.isnan(earlier)]
    instead = float(known.mean()) if len(known) else 0.0
    upper = np.inf if most is None else most
    return _Draws(
        counted,
        before,
        np.nan_to_num(counted.distances, nan=0.0 if most is None else most),
        np.clip(np.nan_to_num(predicted, nan=instead), 0.0, upper),
        np.clip(np.nan_to_num(elsewhere, nan=instead), 0.0, upper),
        int(np.isnan(predicted).sum()),
    )


def _require_usable(sample: Sample, counted: Sample, most: float | None) -> None:
    if most is None and counted.failed:
        raise CertificateError(
            f"{violations(counted)}, so the expected distance is not known; state largest_possible, and each of them "
            f"counts as the largest possible distance.{advice_to_remeasure(counted)}"
        )
    if most is None and len(counted) < _FEWEST:
        raise CertificateError(
            f"without largest_possible the interval needs at least {_FEWEST} independent draws, got {len(counted)}."
        )
    if most is not None and sample.best > most:
        raise CertificateError(
            f"largest_possible must not be below any distance, got {most:g}, but a distance is {at_most(sample.best)}."
        )
    if (sample.distances < 0).any():
        raise CertificateError("a mean certificate needs distances that are not negative.")


def _quantile_limits(counted: Sample, level: float, beta: float) -> tuple[float | None, float | None]:
    """Return the distances between which a quantile lies; None if the draws are too few for a limit on that side."""
    ordered = np.sort(np.nan_to_num(counted.distances, nan=np.inf))
    low, high = quantile_ranks(len(ordered), level, beta)
    lower, upper = (None if rank is None else float(ordered[rank - 1]) for rank in (low, high))
    return lower, None if upper is None or not np.isfinite(upper) else upper


def _statement(
    sample: Sample,
    draws: _Draws,
    interval: Interval,
    limits: tuple[float | None, float | None],
    confidence: float,
    options: Mean,
) -> str:
    over = "uniform over the task space" if sample.distribution is None else "from the stated distribution of tasks"
    asymptotic = options.largest_possible is None
    how = f", as far as a normal approximation for {len(draws.values)} draws holds" if asymptotic else ""
    what = "distance" if not draws.counted.failed else f"distance, with failures as {options.largest_possible:g},"
    expected = (
        f"With confidence {confidence}{how}, the expected {what} of a task {over} is between {at_least(interval.low)} "
        f"and {at_most(interval.high)} (estimate {interval.estimate:.4g})"
    )
    if options.quantile is None:
        return f"{expected}; this is no bound on d*."
    return f"{expected}, and its {options.quantile:g} quantile {_between(*limits)}; this is no bound on d*."


def _between(low: float | None, high: float | None) -> str:
    above = "" if low is None else f"at least {at_least(low)}"
    below = "has no upper limit from so few draws" if high is None else f"at most {at_most(high)}"
    if low is None or high is None:
        return f"is {above}, and {below}" if above else (below if high is None else f"is {below}")
    return f"is {above} and {below}"


def _assumptions(sample: Sample, draws: _Draws, options: Mean) -> tuple[str, ...]:
    if options.largest_possible is None:
        valid = (
            "the number of draws is large enough for a normal approximation: the interval is asymptotic and no bound "
            "in finite samples, and rare large distances that were not drawn make it too narrow (state "
            "largest_possible if a bound of the distance is known)"
        )
    else:
        valid = (
            f"no distance can exceed {options.largest_possible:g}; the interval is then valid for any number of draws"
        )
    return (
        *how_drawn(sample, draws.counted),
        valid,
        FROZEN,
        UNSEEN,
        "if executions of one task differ, the expectation is over the tasks and their executions",
        "nothing is said of the largest distance: this is no bound on d*, and it validates no threshold",
        *sample.remarks,
        ONE_CAMPAIGN,
    )


def _details(
    sample: Sample, draws: _Draws, interval: Interval, limits: tuple[float | None, float | None], options: Mean
) -> dict[str, Any]:
    quantile = {"quantile": options.quantile, "quantile_low": limits[0], "quantile_high": limits[1]}
    return {
        "estimate": interval.estimate,
        "lower_limit": interval.low,
        "upper_limit": interval.high,
        "interval": "asymptotic" if options.largest_possible is None else "valid in finite samples",
        **(quantile if options.quantile is not None else {}),
        "mean_drawn": float(draws.values.mean()),
        "weight": interval.weight,
        "variance_left": interval.variance_left,
        "learned_before": draws.before,
        "predictions": len(draws.elsewhere),
        "unpredicted_draws": draws.unpredicted,
        "not_counted": not_counted(sample, draws.counted),
        "failed": sample.failed,
        "failures": sample.failures,
    }
