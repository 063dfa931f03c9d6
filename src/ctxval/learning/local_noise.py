"""Noise that varies with state and input: other in a region, such as on gravel, or more where the system is fast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ctxval._util.arrays import Array


@dataclass(frozen=True)
class LocalNoiseSettings:
    """By how much noise must differ between places to be no chance."""

    prior: float = 8.0  # innovations of the average size that each average holds
    gain: float = 6.0  # least gain of the log likelihood of innovations that were left out
    split_gain: float = 15.0  # least gain by a split at the best of all places
    fewest: int = 20  # fewest innovations on each side of it
    least: float = 1e-4  # least relative variance: without it, records without noise would outweigh all others


@dataclass(frozen=True)
class Split:
    """A place in one coordinate at which noise changes, and the part on each side: a variance or a further split."""

    coordinate: int
    at: float
    below: Split | float
    above: Split | float

    def __call__(self, pairs: Array) -> Array:
        """Return the variances ``(N,)`` at pairs ``(N, n + m)``."""
        sides = [side(pairs) if isinstance(side, Split) else side for side in (self.below, self.above)]
        return np.where(pairs[:, self.coordinate] <= self.at, *sides)


@dataclass(frozen=True, eq=False)
class LocalNoise:
    """The standard deviation of innovations relative to the constant one: parts, times an average over centres."""

    parts: Split | None  # None if no coordinate has a place at which noise changes
    centres: Array  # standardised states and inputs, (C, n + m); none if noise is the same within each part
    variances: Array  # the variances there relative to those of the parts, (C,)
    before: LocalNoise | None = None  # to which this one is relative; None if to a constant

    def __call__(self, pairs: Array) -> Array:
        """Return the relative standard deviations ``(N,)`` at standardised states and inputs ``(N, n + m)``."""
        variances = np.ones(len(pairs)) if self.parts is None else self.parts(pairs)
        if len(self.centres):
            K = _near(pairs, self.centres) + 1e-12
            variances = variances * (K @ self.variances / K.sum(axis=1))
        return np.asarray(np.sqrt(variances) * (1.0 if self.before is None else self.before(pairs)))


def local_noise(
    pairs: Array, innovations: Array, settings: LocalNoiseSettings = LocalNoiseSettings()
) -> LocalNoise | None:
    """Return how unit innovations ``(N, k)`` vary over states and inputs; None if a constant is about as likely.

    Where noise begins at a place, such as an edge, an average over neighbours would be too small inside: such places
    split the space first. Then squared innovations are averaged around each point, with a prior of the constant one.
    The average must predict those that are left out.
    """
    if not innovations.shape[1]:
        return None
    squares = (innovations**2).mean(axis=1)
    squares = squares / max(squares.mean(), 1e-300)
    parts = _parts(pairs, squares, innovations.shape[1], settings)
    split = parts if isinstance(parts, Split) else None
    if split is not None:
        squares = squares / split(pairs)
    rng = np.random.default_rng(len(pairs))
    some = rng.permutation(len(pairs))[:400]
    K = _near(pairs[some], pairs)
    K[np.arange(len(some)), some] = 0.0
    averages = (K @ squares + settings.prior) / (K.sum(axis=1) + settings.prior)
    # The log likelihood of normal innovations with these variances, above that with a variance of 1.
    gains = -0.5 * innovations.shape[1] * (np.log(averages) + squares[some] / averages - squares[some])
    if gains.sum() <= settings.gain:
        return None if split is None else LocalNoise(split, pairs[:0], np.empty(0))
    centres = pairs[rng.permutation(len(pairs))[:80]]
    K = _near(centres, pairs)
    return LocalNoise(split, centres, (K @ squares + settings.prior) / (K.sum(axis=1) + settings.prior))


def _parts(pairs: Array, squares: Array, k: int, settings: LocalNoiseSettings) -> Split | float:
    """Return the variance of squared innovations ``(N,)``, the means of k each, or those on both sides of a split."""
    n, mean = len(squares), max(float(squares.mean()), settings.least)
    if n >= 2 * settings.fewest:
        count, order = np.arange(1, n)[:, None], np.argsort(pairs, axis=0, kind="stable")
        ordered, gains = np.take_along_axis(pairs, order, axis=0), list[Array]()
        # Of the log likelihood of normal innovations, and of those with heavier tails: a few large ones, such as hits
        # of a wall, are no noise that begins somewhere.
        limited = np.maximum(squares, settings.least)
        for values, power in ((limited, 0.5 * k), (np.sqrt(limited), 1.0 * k)):
            total = np.cumsum(values[order], axis=0)
            below, above = total[:-1] / count, (total[-1] - total[:-1]) / (n - count)
            gains.append(power * (n * np.log(values.mean()) - count * np.log(below) - (n - count) * np.log(above)))
        gain = np.minimum(*gains)
        gain[(ordered[1:] == ordered[:-1]) | (np.minimum(count, n - count) < settings.fewest)] = -np.inf
        row, j = map(int, np.unravel_index(int(gain.argmax()), gain.shape))
        if gain[row, j] > settings.split_gain:
            at = float(ordered[row : row + 2, j].mean())
            low = pairs[:, j] <= at
            return Split(j, at, *(_parts(pairs[side], squares[side], k, settings) for side in (low, ~low)))
    return mean


def _near(pairs: Array, others: Array) -> Array:
    # The width of the kernel average is half a standard deviation of the data.
    return np.asarray(np.exp(-0.5 * scipy.spatial.distance.cdist(pairs, others, "sqeuclidean") / 0.5**2))
