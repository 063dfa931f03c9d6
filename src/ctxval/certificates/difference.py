r"""The sign of an expected difference of two distances, by a test that may stop at any time.

Let D_i be the difference of the two distances of task i, h_i a prediction of it that was fixed before the task was
drawn, and mu_i the mean of h_i over tasks that were drawn for this purpose only. Then

    X_i = D_i - w_i (h_i - mu_i)

has the expected difference as its mean given all earlier tasks, whatever the prediction is, if the weight w_i follows
from earlier tasks: prediction-powered inference (Angelopoulos et al. 2023, Science 382) in a sequential form. The mean
m is rejected if the wealth of bets against it reaches 2 / beta, on either side (Ville's inequality).

- If no distance can exceed a stated number, X_i is bounded, and the bets are linear (Waudby-Smith and Ramdas 2024,
  JRSS B 86). The test is then valid for any distribution.
- Otherwise a bet multiplies the wealth by 1 + k tanh(b_i (X_i - m) / k), with b_i of the order of 1 / sqrt(i log i)
  standard deviations. This is exact if X_i is symmetric about its mean, as a sign test is, and otherwise asymptotic
  (docs/theory.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array


@dataclass(frozen=True)
class BetSettings:
    """How bets on the differences of two models are placed."""

    largest: float = 0.9  #: gain or loss of one bet on unbounded differences, as a share of the wealth
    few: int = 4  #: with fewer earlier tasks, all of them count as recent


BETS = BetSettings()
"""The settings in use."""


@dataclass(frozen=True, eq=False)
class PairedDifferences:
    """Differences of two distances at independent tasks, in the order of drawing."""

    values: Array  #: differences D_i, shape ``(N,)``
    predicted: Array  #: what was predicted for each before its task was drawn, minus the mean of this prediction, or 0
    most: float | None = None  #: a number that no distance can exceed; None if none is known

    @property
    def corrected(self) -> Array:
        """The differences X_i with the prediction as control variate, shape ``(N,)``."""
        return np.asarray(self.values - _weights_so_far(self.values, self.predicted) * self.predicted)

    def log_wealth(self, mean: Array, *, above: bool) -> Array:
        """Return the log of the largest wealth ``(..., N)`` of bets that the true mean is above or below ``(...)``."""
        sign = 1.0 if above else -1.0
        against = sign * np.asarray(mean, dtype=np.float64)[..., None]
        if self.most is None:
            # Predictions improve from task to task; without any, all earlier tasks show the scale.
            wealth = _by_symmetry(sign * self.corrected - against, recent=bool(np.any(self.predicted)))
        else:
            weights = _weights_so_far(self.values, self.predicted)
            plain = _by_bound(sign * self.values, against, -self.most * np.ones(len(self.values)), self.most)
            # The prediction minus its mean lies within +- 2 most, whatever the mean is.
            lowest = -self.most * (1 + 2 * weights)
            powered = _by_bound(sign * (self.values - weights * self.predicted), against, lowest, self.most)
            wealth = np.logaddexp(plain, powered) - np.log(2)
        return np.asarray(np.maximum.accumulate(np.maximum(wealth, 0.0), axis=-1))


@dataclass(frozen=True)
class MeanDifference:
    """The expected difference of two distances, as far as the tasks so far tell."""

    estimate: float | None  #: the estimate; None if there is no task
    #: low, high: the ends of the confidence sequence; infinite if nothing is known
    low: float
    high: float
    sign: int  #: 1 if the expected difference is above 0, -1 if it is below, 0 if this is not decided
    decided_after: int | None  #: the number of tasks after which the sign was decided; None if it is not
    tasks: int  #: the number of tasks
    #: the variance of the later half of the corrected differences, as a share of that of the differences; None if there
    #: are too few tasks
    variance_left: float | None


def mean_difference(differences: PairedDifferences, beta: float) -> MeanDifference:
    """Return the expected difference; its interval and decision are ever wrong with probability beta."""
    count = len(differences.values)
    if not count:
        return MeanDifference(None, -np.inf, np.inf, 0, None, 0, None)
    level, corrected = float(np.log(2 / beta)), differences.corrected
    reached = [np.flatnonzero(differences.log_wealth(np.array(0.0), above=side) >= level) for side in (True, False)]
    crossed = [int(rows[0]) + 1 if len(rows) else None for rows in reached]
    after = min((count for count in crossed if count is not None), default=None)
    sign = 0 if after is None else -1 if crossed[1] == after else 1
    # Each difference counts by the inverse size of the earlier deviations.
    middle = np.concatenate([[corrected[0]], (np.cumsum(corrected) / np.arange(1, count + 1))[:-1]])
    size = _recent_size(corrected - middle)
    weights = np.where(np.isfinite(size) & (size > 0), 1 / np.where(size > 0, size, 1.0), 0.0)
    weights[:2] = 0.0  # nothing is known of the deviations yet
    centre = float(np.average(corrected, weights=weights) if weights.any() else corrected.mean())
    low, high = (_end(differences, centre, level, above=above) for above in (True, False))
    spread = float(differences.values.var())
    left = min(1.0, float(corrected[count // 2 :].var()) / spread) if count > BETS.few and spread > 0 else None
    estimate = float(np.clip(centre, low, high))
    return MeanDifference(estimate, low, high, sign, after, count, left)


def _by_symmetry(centred: Array, *, recent: bool) -> Array:
    """Return the log wealth of bets on values that are symmetric about 0 or lower; the first sets the scale."""
    before = np.arange(centred.shape[-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        of_all = np.sqrt((np.cumsum(centred**2, axis=-1) - centred**2) / before)
        scale = _recent_size(centred) if recent else of_all
        bets = np.sqrt(2 * np.log(20.0) / (np.maximum(before, 1) * np.log1p(np.maximum(before, 1)))) / scale
    gain = np.where(np.isfinite(bets), bets, 0.0) * centred
    return np.asarray(np.cumsum(np.log1p(BETS.largest * np.tanh(gain / BETS.largest)), axis=-1))


def _recent_sum(values: Array) -> Array:
    """Return for each task the sum over the later half of the earlier tasks, ``(..., N)``; over all if they are few."""
    ends = np.arange(values.shape[-1])
    starts = np.where(ends >= BETS.few, ends // 2, 0)
    sums = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)
    return np.asarray(sums[..., ends] - sums[..., starts])


def _weights_so_far(values: Array, predicted: Array) -> Array:
    """Return for each task the slope of values against predictions among the recent earlier ones, from 0 to 1."""
    count = _recent_sum(np.ones(values.shape[-1]))
    of_values, of_predicted, of_products, of_squares = map(
        _recent_sum, (values, predicted, values * predicted, predicted**2)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = (of_products - of_values * of_predicted / count) / (of_squares - of_predicted**2 / count)
    return np.asarray(np.where(np.isfinite(slope) & (count >= 3), np.clip(slope, 0.0, 1.0), 1.0))


def _recent_size(values: Array) -> Array:
    """Return for each task the root mean square of the recent earlier values, ``(..., N)``; NaN for the first task."""
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_square = _recent_sum(values**2) / _recent_sum(np.ones(values.shape[-1]))
    return np.sqrt(np.maximum(mean_square, 0.0))


def _by_bound(values: Array, mean: Array, lowest: Array, most: float) -> Array:
    """Return the log wealth of bets that values above ``lowest`` have a mean above the given one, ``(..., N)``."""
    count = np.arange(1, len(values) + 1)
    deviations = (values - np.cumsum(values) / (count + 1)) ** 2
    spread = (most**2 / 16 + np.cumsum(deviations) - deviations) / count
    wanted = np.sqrt(2 * np.log(20.0) / (spread * count * np.log1p(count)))
    return _log_wealth_of_bets(values - mean, wanted, mean - lowest)


def _log_wealth_of_bets(gains: Array, wanted: Array, room: Array) -> Array:
    """Return the log wealth of bets that win ``gains`` with each draw and can lose ``room`` at most, ``(..., N)``."""
    # A bet is at most 3/4 of that with which one draw could lose everything; without room no draw can lose.
    won = np.minimum(wanted, 0.75 / np.maximum(room, 1e-300)) * gains
    return np.asarray(np.cumsum(np.log1p(np.maximum(won, -0.75)), axis=-1))


def _end(differences: PairedDifferences, centre: float, level: float, *, above: bool) -> float:
    """Return the lower end (bets above) or the upper end of the interval: the outermost mean that is not rejected."""
    sign = 1.0 if above else -1.0
    size = float(np.abs(differences.corrected - centre).mean()) or abs(centre) or 1.0
    outermost = 1e6 * size if differences.most is None else differences.most + sign * centre
    steps = outermost * np.concatenate([np.geomspace(1, 1e-9, 400), [0.0]])

    def kept(means: Array) -> Array:
        return np.asarray(differences.log_wealth(means, above=above)[..., -1] < level)

    inside = np.flatnonzero(kept(centre - sign * steps))
    if not len(inside):
        return centre
    if not inside[0]:
        return -sign * np.inf if differences.most is None else -sign * differences.most
    outer, inner = centre - sign * steps[inside[0] - 1], centre - sign * steps[inside[0]]
    for _ in range(60):
        middle = 0.5 * (outer + inner)
        outer, inner = (outer, middle) if kept(np.array(middle)) else (middle, inner)
    return float(outer)
