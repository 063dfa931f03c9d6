"""Noise that varies with state and input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array

_PRIOR = 8.0  # innovations of the average size that each average holds


@dataclass(frozen=True, eq=False)
class LocalNoise:
    """The standard deviation of innovations relative to the constant one, as an average over centres."""

    centres: Array  # standardised states and inputs, (C, n + m)
    variances: Array  # the relative variances there, (C,)

    def __call__(self, pairs: Array) -> Array:
        """Return the relative standard deviations ``(N,)`` at standardised states and inputs ``(N, n + m)``."""
        K = _near(pairs, self.centres) + 1e-12
        return np.asarray(np.sqrt(K @ self.variances / K.sum(axis=1)))


def local_noise(pairs: Array, innovations: Array) -> LocalNoise | None:
    """Return how unit innovations ``(N, k)`` vary over states and inputs; None if a constant is about as likely.

    The squared innovations are averaged around each point with a prior of the constant one. The average must predict
    those that are left out.
    """
    if not innovations.shape[1]:
        return None
    squares = (innovations**2).mean(axis=1)
    squares = squares / max(squares.mean(), 1e-300)
    rng = np.random.default_rng(len(pairs))
    some = rng.permutation(len(pairs))[:400]
    K = _near(pairs[some], pairs)
    K[np.arange(len(some)), some] = 0.0
    averages = (K @ squares + _PRIOR) / (K.sum(axis=1) + _PRIOR)
    # The log likelihood of normal innovations with these variances, above that with a variance of 1.
    gains = -0.5 * innovations.shape[1] * (np.log(averages) + squares[some] / averages - squares[some])
    if gains.sum() <= 6.0:  # least gain of the log likelihood of innovations that were left out
        return None
    centres = pairs[rng.permutation(len(pairs))[:80]]
    K = _near(centres, pairs)
    return LocalNoise(centres, (K @ squares + _PRIOR) / (K.sum(axis=1) + _PRIOR))


def _near(pairs: Array, others: Array) -> Array:
    # The width of the kernel average is half a standard deviation of the data.
    return np.asarray(np.exp(-0.5 * cdist(pairs, others, "sqeuclidean") / 0.5**2))
