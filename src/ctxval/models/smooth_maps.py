"""Differentiable functions of rows: the one way from a learned map to a model with a Jacobian.

Derivatives are pulled back from the outputs to the inputs (reverse mode): a model has fewer outputs than inputs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ctxval._util.arrays import Array

PullBack = Callable[[Array], Array]  # from derivatives by the values of a map, (N, p, o), to those by rows, (N, p, k)


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """A function from rows ``(N, k)`` to values ``(N, o)``."""

    linearised: Callable[[Array], tuple[Array, PullBack]]  # the values at rows, and what pulls derivatives back to them
    block: int = 1024  # rows that are evaluated together: enough to be fast, few enough for the cache

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""
        if len(Z) <= self.block:
            return self.linearised(Z)[0]
        return np.concatenate([self.linearised(rows)[0] for rows in self._blocks(Z)])

    def expanded(self, Z: Array) -> tuple[Array, Array]:
        """Return the values ``(N, o)`` and the derivatives ``(N, o, k)`` at rows ``(N, k)``."""
        if len(Z) > self.block:
            values, derivatives = map(np.concatenate, zip(*map(self.expanded, self._blocks(Z)), strict=True))
            return values, derivatives
        values, pull_back = self.linearised(Z)
        outputs = values.shape[1]
        return values, pull_back(np.broadcast_to(np.eye(outputs), (len(values), outputs, outputs)))

    def _blocks(self, Z: Array) -> list[Array]:
        return [Z[first : first + self.block] for first in range(0, len(Z), self.block)]


def relu_network(weights: Sequence[Array], biases: Sequence[Array]) -> SmoothMap:
    """Return a feedforward network with a linear last layer; its weights have shapes ``(k, h), (h, h'), ...``.

    At its kink, a ReLU counts as inactive.
    """

    def linearised(Z: Array) -> tuple[Array, PullBack]:
        hidden: list[Array] = []
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            Z = np.maximum(Z @ weight + bias, 0.0)
            hidden.append(Z)

        def pull_back(G: Array) -> Array:
            G = G @ weights[-1].T
            for units, weight in zip(reversed(hidden), reversed(weights[:-1]), strict=True):
                G = G * (units > 0)[:, None, :]
                # One product of two matrices is far faster than one for each row.
                G = (G.reshape(-1, G.shape[-1]) @ weight.T).reshape(*G.shape[:2], -1)
            return G

        return Z @ weights[-1] + biases[-1], pull_back

    return SmoothMap(linearised)


# Sums of kernels around centres (Rasmussen and Williams 2006, chapter 4)

Kernel = Callable[[Array, Array], tuple[Array, Callable[[], Array]]]
"""Maps points z ``(N, k)`` and centres x ``(M, k)`` to ``k(z, x)``, ``(N, M)``, and a function that returns factors.

The derivative by z_j is ``factor (x_j - z_j) / l_j^2`` with the length-scales l.
"""


def kernel_sum(
    kernel: Kernel, length_scales: Array, centres: Array, weights: Array, *, linear: Array | None = None, block: int
) -> SmoothMap:
    """Return the map ``sum_i k(z, x_i) w_i`` of centres x_i ``(M, k)`` and weights w_i ``(M, o)``.

    A linear map ``(k + 1, o)`` is added, slopes first and then the constant.
    """

    @functools.cache
    def columns() -> Array:
        """Return w and w x of the centres: sums over the centres of a factor times these are all that a slope takes."""
        moments = (weights[:, :, None] * centres[:, None, :]).reshape(len(centres), -1)
        return np.concatenate([weights, moments], axis=1)

    def linearised(Z: Array) -> tuple[Array, PullBack]:
        covariances, factors = kernel(Z, centres)
        outputs, values = weights.shape[1], covariances @ weights

        def pull_back(G: Array) -> Array:
            sums = factors() @ columns()
            drawn = sums[:, outputs:].reshape(len(Z), outputs, -1) - sums[:, :outputs, None] * Z[:, None, :]
            derivatives = drawn * length_scales**-2.0
            return np.asarray(G @ (derivatives if linear is None else derivatives + linear[:-1].T))

        return values if linear is None else values + (Z @ linear[:-1] + linear[-1]), pull_back

    return SmoothMap(linearised, block)


def matern(length_scales: Array) -> Kernel:
    """Return the Matern kernel of smoothness 5/2 with length-scales ``(k,)``."""

    def kernel(Z: Array, X: Array) -> tuple[Array, Callable[[], Array]]:
        r = np.sqrt(5.0) * scipy.spatial.distance.cdist(Z / length_scales, X / length_scales)
        decay = np.exp(-r)
        return (1 + r + r**2 / 3) * decay, lambda: 5 / 3 * (1 + r) * decay

    return kernel
