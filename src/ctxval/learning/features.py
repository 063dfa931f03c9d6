"""Features of a Gaussian process of low rank: Matern functions at centres, and linear parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.gp.kernels import Matern


class LinearFunction(NamedTuple):
    """Weights of the Matern functions ``(M, n)`` and of the linear parts."""

    matern: Array
    linear: Array


@dataclass(frozen=True, eq=False)
class Features:
    """Features whose weights are independent a priori: those of a Matern-5/2 process, 1, z, and inputs times states.

    The products let the residual grow with the input, as that of a wrong gain does.
    """

    centres: Array  # standardised regressors, (M, D)
    theta: Array  # logarithms of a unit variance and of the length-scales, (1 + D,)
    linear: float  # standard deviation of the linear part, relative to that of the Matern part
    # states, inputs: the numbers n and m; regressors begin with the state and the input
    states: int
    inputs: int
    whiten: Array  # makes the weights of the Matern part independent, (M, M)
    products: bool = True  # whether inputs times states are among the features

    @classmethod
    def of(
        cls, centres: Array, scales: Array, linear: float, states: int, inputs: int, products: bool = True
    ) -> Features:
        """Return the features with length-scales ``(D,)``."""
        theta = np.concatenate([[0.0], np.log(scales)])
        K = Matern(2.5, ard=True)(theta, centres, centres)
        L = np.linalg.cholesky(K + 1e-8 * np.eye(len(K)))
        return cls(centres, theta, linear, states, inputs, np.linalg.inv(L).T, products)

    def __call__(self, z: Array) -> Array:
        """Return the features ``(N, F)`` of standardised regressors ``(N, D)``."""
        return np.concatenate([self._matern(z) @ self.whiten, self._linear(z)], axis=1)

    def function(self, weights: Array) -> LinearFunction:
        """Return the sum of the features with weights ``(F, n)``, which is cheaper than the features."""
        M = len(self.centres)
        return LinearFunction(self.whiten @ weights[:M], weights[M:])

    def values(self, z: Array, functions: Sequence[tuple[Rows, LinearFunction]]) -> Array:
        """Return the values ``(N, n)`` of functions at regressors ``(N, D)``, each at some rows."""
        matern, linear = self._matern(z), self._linear(z)
        values = np.empty((len(z), self.states))
        for rows, function in functions:
            values[rows] = matern[rows] @ function.matern + linear[rows] @ function.linear
        return values

    def _matern(self, z: Array) -> Array:
        scales = np.exp(-self.theta[1:])
        scaled, centres = z * scales, self.centres * scales
        s = scaled @ centres.T
        s *= -2.0
        s += (scaled**2).sum(axis=1)[:, None]
        s += (centres**2).sum(axis=1)
        np.maximum(s, 0.0, out=s)
        s *= 5.0
        np.sqrt(s, out=s)
        values = s / 3.0
        values += 1.0
        values *= s
        values += 1.0
        np.negative(s, out=s)
        values *= np.exp(s, out=s)
        return np.asarray(values)

    def _linear(self, z: Array) -> Array:
        parts = [np.ones((len(z), 1)), z]
        if self.products:
            x, u = z[:, : self.states], z[:, self.states : self.states + self.inputs]
            # Standard deviation of products of an input and a state, relative to that of the linear part.
            parts.append(0.3 * (u[:, :, None] * x[:, None, :]).reshape(len(z), -1))
        return self.linear * np.concatenate(parts, axis=1)


def spread_rows(Z: Array, count: int) -> Rows:
    """Return at most so many rows, each farthest from those before it."""
    rows, gaps = [0], ((Z - Z[0]) ** 2).sum(axis=1)
    while len(rows) < min(count, len(Z)):
        rows.append(int(gaps.argmax()))
        gaps = np.minimum(gaps, ((Z - Z[rows[-1]]) ** 2).sum(axis=1))
    return np.array(rows, dtype=np.intp)
