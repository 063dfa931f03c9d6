"""What is promised at points: a prediction, corrected by its errors at known points and raised by its doubt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.gp.kernels import Matern
from ctxval.gp.regression import GaussianProcess, condition
from ctxval.gp.subset import kept_rows
from ctxval.gp.surrogate import fit_surrogate
from ctxval.searches.base import Prediction

REPRESENTING = 150
"""Largest number of known values from which the discrepancy and the surrogate's errors are computed."""
_LOG_OFFSET = 1e-3
"""The c of ``log(d + c)`` in the discrepancy, in medians of the known values."""
_ERROR_OFFSET = 0.1
"""The c of ``log(d + c)`` in errors of predictions, in medians of the known values: small values count little."""
_LENGTH_SCALE = 0.15
"""Length-scale of the discrepancy's kernel, divided by the square root of the dimension."""
_NOISES = (1e-4, 1e-3, 1e-2, 0.1, 0.5)
"""Noise variances of the discrepancy, as shares of its variance; the most likely one is used."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A point with what is predicted there.

    Attributes:
        point: a point of the unit cube ``(d,)``.
        expected, doubt: the prediction and its doubt.
        corrected, left: the prediction times the discrepancy, and the doubt that remains.
    """

    point: Array
    expected: float
    doubt: float
    corrected: float
    left: float

    def optimistic(self, optimism: float) -> float:
        """Return the optimistic value with this kappa."""
        return self.corrected * (1 + optimism * self.left)


@dataclass(frozen=True, eq=False)
class OptimisticValue:
    """The optimistic value of points: the prediction, corrected and raised in proportion to its doubt.

    Attributes:
        prediction: the prediction d_hat and its doubt w.
        discrepancy: the correction g; None if it is not used.
        optimism: the factor kappa of the doubt.
    """

    prediction: Prediction
    discrepancy: GaussianProcess | None
    optimism: float

    @property
    def rough(self) -> OptimisticValue | None:
        """The same with the rough prediction; None if there is none."""
        rough = self.prediction.rough
        return None if rough is None else replace(self, prediction=replace(self.prediction, expected=rough))

    def __call__(self, points: Array) -> Array:
        """Return the optimistic values ``(m,)`` of points ``(m, d)``."""
        expected, doubt = self._corrected(points, *self.prediction.expected(points))
        return np.asarray(expected * (1 + self.optimism * doubt))

    def at(self, point: Array) -> Candidate:
        """Return a point ``(d,)`` with what is predicted there."""
        expected, doubt = self.prediction.expected(point[None])
        corrected = self._corrected(point[None], expected, doubt)
        return Candidate(point, *(float(one[0]) for one in (expected, doubt, *corrected)))

    def _corrected(self, points: Array, expected: Array, doubt: Array) -> tuple[Array, Array]:
        """Return the prediction times the discrepancy, and the doubt that remains near known points."""
        if self.discrepancy is None:
            return expected, doubt
        mean, variance = self.discrepancy.predict(points)
        # At a point with a known value there is no doubt, even if the dynamics on its trajectory are uncertain.
        share = variance / self.discrepancy.kernel.diagonal(self.discrepancy.theta, points)
        return expected * np.exp(mean), doubt * np.sqrt(share)


def log_error(expected: Array, values: Array) -> float:
    """Return the mean error of the logarithm; small values count little."""
    if not np.isfinite(expected).all():
        return np.inf
    floor = max(_ERROR_OFFSET * float(np.median(values)), 1e-12)
    return float(np.abs(np.log(np.maximum(expected, 0.0) + floor) - np.log(values + floor)).mean())


def represented(points: Array, values: Array) -> Rows:
    """Return the rows of a long history that represent all of it, in their order; they end with the latest ones."""
    return kept_rows(points, values, REPRESENTING, long=REPRESENTING)


def left_out_by_surrogate(points: Array, values: Array) -> Array:
    """Return leave-one-out predictions ``(n,)`` by the surrogate of the values."""
    surrogate = fit_surrogate(points, values)
    return np.asarray(surrogate.shift + surrogate.scale * surrogate.process.left_out()[0])


def discrepancy(
    prediction: Prediction, points: Array, values: Array, learn_noise: bool = True
) -> GaussianProcess | None:
    """Return the GP of ``log(d + c) - log(d_hat + c)`` over the points; None if no point has both values.

    Args:
        prediction: the prediction d_hat.
        points, values: known values ``(n,)`` at points ``(n, d)``.
        learn_noise: whether the noise is learned; if not, it is the smallest one.
    """
    kept = represented(points, values)
    points, values = points[kept], values[kept]
    if not len(values):
        return None
    expected = prediction.expected(points)[0]
    floor = max(_LOG_OFFSET * float(np.median(values)), 1e-12)
    ratio = np.log(values + floor) - np.log(np.maximum(expected, 0.0) + floor)
    usable = np.isfinite(ratio)
    if not usable.any():
        return None
    size = max(float((ratio[usable] ** 2).mean()), 1e-8)
    theta = np.log([size, _LENGTH_SCALE * np.sqrt(points.shape[1])])
    noises = _NOISES if learn_noise else _NOISES[:1]
    found = [condition(Matern(2.5), theta, points[usable], ratio[usable], noise=share * size) for share in noises]
    return max(found, key=GaussianProcess.log_marginal_likelihood)
