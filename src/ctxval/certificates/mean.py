"""The expected distance over the distribution of tasks, and a quantile of it, from independent draws.

The prediction of the distance is a control variate: it is fixed before the draws, so what is known of it at other tasks
lowers the variance of the estimate and never makes it wrong. See :mod:`ctxval.certificates.intervals`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import Must, PositiveFloat, Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.bounds import at_most
from ctxval.certificates.draws import countable_draws, not_counted
from ctxval.certificates.dynamics_evidence import LearnedDistance
from ctxval.certificates.intervals import asymptotic_interval, betting_interval, quantile_ranks
from ctxval.certificates.sample import Sample, advice_to_remeasure, require_learned
from ctxval.certificates.sentences import (
    FROZEN,
    ONE_CAMPAIGN,
    UNSEEN,
    between,
    expected_distance,
    how_drawn,
    violations,
)
from ctxval.errors import CertificateError

_FEWEST = 10  # draws of an asymptotic interval: below it, the normal approximation is not trusted at all


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
    sorts_draws: ClassVar[bool] = True
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
    """Independent draws that count, with their predictions, and the predictions of M other tasks.

    The distances of failed ones are the largest possible distance; ``before`` is the number of the first of the draws.
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

    Raises:
        CertificateError: if the experiment is not loaded, too few independent draws count, or a draw failed and no
            largest possible distance is stated.
    """
    chosen = options or Mean()
    most, level = chosen.largest_possible, chosen.quantile
    draws = _draws_of(sample, require_learned(sample, "mean"), chosen)
    beta = 1 - confidence if level is None else (1 - confidence) / 2
    if most is None:
        interval = asymptotic_interval(draws.values, draws.predicted, draws.elsewhere, beta)
        valid = (
            "the number of draws is large enough for a normal approximation: the interval is asymptotic and no bound "
            "in finite samples, and rare large distances that were not drawn make it too narrow (state "
            "largest_possible if a bound of the distance is known)"
        )
    else:
        interval = betting_interval(draws.values, draws.predicted, draws.elsewhere, most, beta)
        valid = f"no distance can exceed {most:g}; the interval is then valid for any number of draws"
    statement = expected_distance(
        *(sample, (interval.estimate, interval.low, interval.high), len(draws.values), confidence, most),
        failed=draws.counted.failed,
    )
    quantile = {}
    if level is not None:
        limits = _quantile_limits(draws.counted, level, beta)
        quantile = {"quantile": level, "quantile_low": limits[0], "quantile_high": limits[1]}
        statement += f", and its {level:g} quantile {between(*limits)}"
    return Certificate(
        kind="mean",
        statement=f"{statement}; this is no bound on d*.",
        upper_bound=float("inf"),
        confidence=confidence,
        volume=1.0,
        trials=len(draws.values),
        assumptions=(
            *how_drawn(sample, draws.counted),
            valid,
            FROZEN,
            UNSEEN,
            "if executions of one task differ, the expectation is over the tasks and their executions",
            "nothing is said of the largest distance: this is no bound on d*, and it validates no threshold",
            *sample.remarks,
            ONE_CAMPAIGN,
        ),
        details={
            "estimate": interval.estimate,
            "lower_limit": interval.low,
            "upper_limit": interval.high,
            "interval": "asymptotic" if most is None else "valid in finite samples",
            **quantile,
            "mean_drawn": float(draws.values.mean()),
            "weight": interval.weight,
            "variance_left": interval.variance_left,
            "learned_before": draws.before,
            "predictions": len(draws.elsewhere),
            "unpredicted_draws": draws.unpredicted,
            "not_counted": not_counted(sample),
            "failed": sample.failed,
            "failures": sample.failures,
        },
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
