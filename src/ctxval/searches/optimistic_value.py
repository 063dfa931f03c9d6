"""What is promised at points: a prediction raised in proportion to its doubt, and how far predictions err."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.gp.subset import kept_rows
from ctxval.gp.surrogate import fit_surrogate
from ctxval.searches.base import Prediction

_REPRESENTING = 150
"""Largest number of known values from which the errors of the surrogate are computed."""
_ERROR_OFFSET = 0.1
"""The c of ``log(d + c)`` in errors of predictions, in medians of the known values: small values count little."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A point with what is predicted there.

    Attributes:
        point: a point of the unit cube ``(d,)``.
        expected, doubt: the prediction and its doubt.
    """

    point: Array
    expected: float
    doubt: float

    def optimistic(self, optimism: float) -> float:
        """Return the optimistic value with this kappa."""
        return self.expected * (1 + optimism * self.doubt)


@dataclass(frozen=True, eq=False)
class OptimisticValue:
    """The optimistic value of points: the prediction, raised in proportion to its doubt.

    Attributes:
        prediction: the prediction d_hat and its doubt w.
        optimism: the factor kappa of the doubt.
    """

    prediction: Prediction
    optimism: float

    @property
    def rough(self) -> OptimisticValue | None:
        """The same with the rough prediction; None if there is none."""
        rough = self.prediction.rough
        return None if rough is None else replace(self, prediction=replace(self.prediction, expected=rough))

    def __call__(self, points: Array) -> Array:
        """Return the optimistic values ``(m,)`` of points ``(m, d)``."""
        expected, doubt = self.prediction.expected(points)
        return np.asarray(expected * (1 + self.optimism * doubt))

    def at(self, point: Array) -> Candidate:
        """Return a point ``(d,)`` with what is predicted there."""
        expected, doubt = self.prediction.expected(point[None])
        return Candidate(point, float(expected[0]), float(doubt[0]))


def log_error(expected: Array, values: Array) -> float:
    """Return the mean error of the logarithm; small values count little."""
    if not np.isfinite(expected).all():
        return np.inf
    floor = max(_ERROR_OFFSET * float(np.median(values)), 1e-12)
    return float(np.abs(np.log(np.maximum(expected, 0.0) + floor) - np.log(values + floor)).mean())


def represented(points: Array, values: Array) -> Rows:
    """Return the rows of a long history that represent all of it, in their order; they end with the latest ones."""
    return kept_rows(points, values, _REPRESENTING, long=_REPRESENTING)


def left_out_by_surrogate(points: Array, values: Array) -> Array:
    """Return leave-one-out predictions ``(n,)`` by the surrogate of the values."""
    surrogate = fit_surrogate(points, values)
    return np.asarray(surrogate.shift + surrogate.scale * surrogate.process.left_out()[0])
