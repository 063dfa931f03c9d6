r"""Confidence intervals of an expected value with a control variate, and of a quantile.

Let d be the values of N independent draws, h a prediction that was fixed before them, and mu_h its mean, estimated from
M predicted points. For any weight w, d - w (h - mu_h) has the mean of d, and less variance if the prediction is good.
With a weight that is chosen from the draws this is prediction-powered inference (Angelopoulos et al. 2023, Science 382;
PPI++, arXiv 2311.01453), whose interval is asymptotic.

If the values are known to lie in [0, most], bets give an interval that is valid for every N (Waudby-Smith and Ramdas
2024, JRSS B 86). If every draw's weight and bet depend only on earlier draws, the wealth

    K_n(m) = prod_i (1 + nu_i (d_i - w_i (h_i - mu_h) - m)),    0 <= nu_i < 1 / (m - least possible value),

is a nonnegative supermartingale if m is at least the mean. By Ville's inequality it reaches 2 / beta with probability
at most beta / 2, so that every m at which it does is rejected; from above in the same way. Half of the wealth is bet
with the weight w_i = 0, which is better if the draws are few: the control variate doubles the range of the values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import bdtr, stdtrit

from ctxval._util.arrays import Array
from ctxval.certificates.bets import log_wealth_of_bets, weights_so_far

_OF_PREDICTIONS = 0.1
"""Share of beta for the mean of the prediction over all tasks; the rest is for the draws."""


@dataclass(frozen=True)
class Interval:
    """An estimate with a two-sided confidence interval.

    Attributes:
        estimate: the estimate.
        low, high: the ends of the interval.
        weight: the weight w of the prediction in the estimate, from 0 to 1.
        variance_left: the variance of d - w h as a share of the variance of d; 1 if the prediction does not help.
    """

    estimate: float
    low: float
    high: float
    weight: float
    variance_left: float


def asymptotic_interval(values: Array, predicted: Array, elsewhere: Array, beta: float) -> Interval:
    """Return the prediction-powered interval of the mean, with the weight that has the least variance (PPI++).

    It uses Student's t distribution with N - 2 degrees of freedom, and is valid for many draws only. Values and
    predictions of draws have shape ``(N,)``, predictions elsewhere ``(M,)``.
    """
    n, m = len(values), len(elsewhere)
    weight = _best_weight(values, predicted, m)
    residual = values - weight * predicted
    estimate = float(residual.mean() + weight * elsewhere.mean())
    variance = residual.var(ddof=1) / n + weight**2 * elsewhere.var(ddof=1) / m
    half = -float(stdtrit(n - 2, beta / 2)) * float(np.sqrt(variance))
    return Interval(estimate, estimate - half, estimate + half, weight, _variance_left(values, residual))


def betting_interval(values: Array, predicted: Array, elsewhere: Array, most: float, beta: float) -> Interval:
    """Return an interval of the mean that is valid for every number of draws.

    Values of draws in their order and their predictions have shape ``(N,)``, predictions elsewhere ``(M,)`` with M >= 2;
    all lie in [0, most].
    """
    centre, slack = mean_of_predictions(elsewhere, most, _OF_PREDICTIONS * beta)
    target = (1 - _OF_PREDICTIONS) * beta

    def rejected(mean: float, above: bool) -> float:
        wealth = log_wealth_against(values, predicted, (centre, slack), most, mean, target, above=above)
        return float(wealth.max() - np.log(2 / target))

    low = _last_positive(lambda mean: rejected(mean, above=True), most)
    high = most - _last_positive(lambda gap: rejected(most - gap, above=False), most)
    weight = _best_weight(values, predicted, len(elsewhere))
    residual = values - weight * predicted
    estimate = float(np.clip(residual.mean() + weight * elsewhere.mean(), low, high))
    return Interval(estimate, low, high, weight, _variance_left(values, residual))


def mean_of_predictions(elsewhere: Array, most: float, beta: float) -> tuple[float, float]:
    """Return the mean of M predictions in [0, most] and its largest error, which is exceeded with probability beta.

    This is the empirical Bernstein bound (Maurer and Pontil 2009, Theorem 4, for both sides).
    """
    m, spread = len(elsewhere), float(elsewhere.var(ddof=1))
    level = np.log(4 / beta)
    return float(elsewhere.mean()), float(np.sqrt(2 * spread * level / m) + 7 * most * level / (3 * (m - 1)))


def log_wealth_against(
    values: Array,
    predicted: Array,
    centre: tuple[float, float],
    most: float,
    mean: float,
    beta: float,
    *,
    above: bool,
) -> Array:
    """Return the logarithm of the wealth after each draw, of bets that the mean is not the given one, ``(..., N)``.

    Args:
        values, predicted: values of the draws and their predictions, shape ``(..., N)``; leading axes are campaigns.
        centre: the estimated mean of the predictions over all points, and its largest error.
        most: the largest possible value.
        mean: the mean that is bet against.
        beta: the probability for which the bets are tuned; any value is valid.
        above: bet that the mean is above the given one; else below.
    """
    plain = _log_wealth(values, np.zeros_like(values), most - np.zeros_like(values), most, mean, beta, above=above)
    about, slack = centre
    weights = weights_so_far(values, predicted, _earlier_sum)
    moved, lowest, highest = values - weights * (predicted - about), -weights * (most - about), most + weights * about
    # The mean of the moved values differs from that of the values by the error of the predictions' mean, at most.
    beyond = mean + slack if above else mean - slack
    powered = _log_wealth(moved, lowest, highest, most, beyond, beta, above=above)
    return np.asarray(np.logaddexp(plain, powered) - np.log(2))


def _log_wealth(
    values: Array, lowest: Array, highest: Array, most: float, mean: float, beta: float, *, above: bool
) -> Array:
    """Return the log wealth of one sequence of bets on values that lie between lowest and highest, ``(..., N)``."""
    wanted = np.sqrt(2 * np.log(2 / beta) / (values.shape[-1] * _earlier_variance(values, most)))
    if above:
        return log_wealth_of_bets(values - mean, wanted, mean - lowest)
    return log_wealth_of_bets(mean - values, wanted, highest - mean)


def quantile_ranks(n: int, level: float, beta: float) -> tuple[int | None, int | None]:
    """Return the ranks, from 1 to n, of the ordered values between which the quantile of this level lies.

    Each side is wrong with probability at most beta / 2, for any distribution: the number of values below the quantile
    is binomial. A rank is None if there are too few values for a limit on its side.
    """
    at_most = bdtr(np.arange(n), n, level)  # Pr(Bin(n, level) <= j) for j = 0, ..., n - 1
    low = int((at_most <= beta / 2).sum())
    enough = np.flatnonzero(at_most >= 1 - beta / 2)
    return low or None, int(enough[0]) + 1 if len(enough) else None


def _best_weight(values: Array, predicted: Array, elsewhere: int) -> float:
    """Return the weight of a prediction with the least variance of the estimate, from 0 to 1."""
    spread = predicted.var()
    if not spread > 0:
        return 0.0
    slope = ((values - values.mean()) * (predicted - predicted.mean())).mean() / spread
    return float(np.clip(slope / (1 + len(values) / elsewhere), 0.0, 1.0))


def _variance_left(values: Array, residual: Array) -> float:
    spread = float(values.var())
    return min(1.0, float(residual.var()) / spread) if spread > 0 else 1.0


def _earlier_variance(values: Array, most: float) -> Array:
    """Return for each draw the variance of the earlier ones, with one draw's worth of prior variance."""
    count = np.arange(1, values.shape[-1] + 1)
    mean = (most / 2 + np.cumsum(values, axis=-1)) / (count + 1)
    return np.asarray((most**2 / 16 + _earlier_sum((values - mean) ** 2)) / count)


def _earlier_sum(values: Array) -> Array:
    return np.cumsum(values, axis=-1) - values


def _last_positive(function: Callable[[float], float], end: float) -> float:
    """Return where a decreasing function becomes negative on [0, end]; 0 if it is negative everywhere."""
    if function(0.0) < 0:
        return 0.0
    return end if function(end) >= 0 else float(brentq(function, 0.0, end, xtol=1e-12 * end))
