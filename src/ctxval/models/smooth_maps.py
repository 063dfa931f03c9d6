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
    constant: bool = False  # whether the derivative is the same everywhere
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


def affine(W: Array, b: Array) -> SmoothMap:
    """Return the map ``z W + b``, with W of shape ``(k, o)`` and b of shape ``(o,)``."""
    return SmoothMap(lambda Z: (np.asarray(Z @ W + b), lambda G: np.asarray(G @ W.T)), constant=True)


def scaled(scale: Array | float, shift: Array | float) -> SmoothMap:
    """Return the map ``scale * z + shift`` of each column; both are numbers, or have shape ``(k,)``."""
    return SmoothMap(lambda Z: (np.asarray(scale * Z + shift), lambda G: np.asarray(G * scale)), constant=True)


def monomials(powers: Array) -> SmoothMap:
    """Return the products of powers of the columns; the powers in each product are integers of shape ``(o, k)``."""

    def products(table: Array, exponents: Array) -> Array:
        values = np.ones((table.shape[1], len(exponents)), dtype=table.dtype)
        for j in np.flatnonzero(exponents.any(axis=0)):
            values *= table[exponents[:, j], :, j].T
        return values

    def linearised(Z: Array) -> tuple[Array, PullBack]:
        # The powers of the columns from 0 to the largest, shape (largest + 1, N, k).
        table = np.ones((int(powers.max(initial=0)) + 1, *Z.shape), dtype=Z.dtype)
        for power in range(1, len(table)):
            table[power] = table[power - 1] * Z

        def pull_back(G: Array) -> Array:
            columns = []
            for j in range(Z.shape[1]):
                with_j = np.flatnonzero(powers[:, j])
                lower = powers[with_j].copy()
                lower[:, j] -= 1
                slopes = powers[with_j, j] * products(table, lower)
                columns.append((G[:, :, with_j] @ slopes[:, :, None])[..., 0])
            return np.stack(columns, axis=-1)

        return products(table, powers), pull_back

    return SmoothMap(linearised, constant=bool((powers.sum(axis=1) <= 1).all()))


ACTIVATIONS: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "identity": (lambda z: z, np.ones_like),
    "logistic": (lambda z: np.asarray(scipy.special.expit(z)), lambda a: a * (1 - a)),
    "tanh": (np.tanh, lambda a: 1 - a * a),
    "relu": (lambda z: np.maximum(z, 0.0), lambda a: (a > 0).astype(np.float64)),
}
"""The functions of units by scikit-learn's names, and their derivatives as functions of their own values.

At its kink, a ReLU counts as inactive.
"""


def network(weights: Sequence[Array], biases: Sequence[Array], activation: str) -> SmoothMap:
    """Return a feedforward network with a linear last layer; its weights have shapes ``(k, h), (h, h'), ...``."""
    function, slope = ACTIVATIONS[activation]

    def linearised(Z: Array) -> tuple[Array, PullBack]:
        hidden: list[Array] = []
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            Z = function(Z @ weight + bias)
            hidden.append(Z)

        def pull_back(G: Array) -> Array:
            G = G @ weights[-1].T
            for units, weight in zip(reversed(hidden), reversed(weights[:-1]), strict=True):
                G = G * slope(units)[:, None, :]
                # One product of two matrices is far faster than one for each row.
                G = (G.reshape(-1, G.shape[-1]) @ weight.T).reshape(*G.shape[:2], -1)
            return G

        return Z @ weights[-1] + biases[-1], pull_back

    return SmoothMap(linearised, constant=activation == "identity" or len(weights) == 1)


def chain(parts: Sequence[SmoothMap]) -> SmoothMap:
    """Return several maps, one after the other."""

    def linearised(Z: Array) -> tuple[Array, PullBack]:
        pulls: list[PullBack] = []
        for part in parts:
            Z, pull = part.linearised(Z)
            pulls.append(pull)

        def pull_back(G: Array) -> Array:
            for pull in reversed(pulls):
                G = pull(G)
            return G

        return Z, pull_back

    return SmoothMap(linearised, constant=all(part.constant for part in parts))


def total(first: SmoothMap, second: SmoothMap) -> SmoothMap:
    """Return the sum of two maps of the same rows, evaluated in the blocks of the first."""

    def linearised(Z: Array) -> tuple[Array, PullBack]:
        (values, pull), (others, other_pull) = first.linearised(Z), second.linearised(Z)
        return values + others, lambda G: pull(G) + other_pull(G)

    return SmoothMap(linearised, first.constant and second.constant, first.block)


# Sums of kernels around centres (Rasmussen and Williams 2006, chapter 4)

Slope = tuple[Array | float, float, Array | float]
"""Terms ``factor (x_j - pull z_j) weight_j`` of the derivative of k(z, x) by z_j: factor, pull and weight.

The factor is a number or has shape ``(N, M)``, and the weight is a number or has shape ``(k,)``. The pull is 1 if the
kernel depends on x - z, and 0 if it depends on x'z.
"""
Slopes = Callable[[], list[Slope]]
Kernel = Callable[[Array, Array], tuple[Array | float, Slopes]]
"""Maps points ``(N, k)`` and centres ``(M, k)`` to ``k(z, x)``, ``(N, M)`` or a number, and the terms of its slope."""


def kernel_sum(kernel: Kernel, centres: Array, weights: Array, block: int = 1024) -> SmoothMap:
    """Return the map ``sum_i k(z, x_i) w_i`` of centres x_i ``(M, k)`` and weights w_i ``(M, o)``."""

    @functools.cache
    def columns() -> Array:
        """Return w and w x of the centres: sums over the centres of a factor times these are all that a slope takes."""
        moments = (weights[:, :, None] * centres[:, None, :]).reshape(len(centres), -1)
        return np.concatenate([weights, moments], axis=1)

    def linearised(Z: Array) -> tuple[Array, PullBack]:
        covariances, slopes = kernel(Z, centres)
        (count, k), outputs, shape = Z.shape, weights.shape[1], (len(Z), len(centres))

        def pull_back(G: Array) -> Array:
            derivatives: Array | float = 0.0
            for factor, pull, weight in slopes():
                sums = np.broadcast_to(factor, shape) @ columns()
                drawn = sums[:, outputs:].reshape(count, outputs, k)
                if pull:
                    drawn = drawn - pull * sums[:, :outputs, None] * Z[:, None, :]
                derivatives = derivatives + drawn * weight
            return np.asarray(G @ np.broadcast_to(derivatives, (count, outputs, k)))

        return np.broadcast_to(covariances, shape) @ weights, pull_back

    return SmoothMap(linearised, block=block)


def matern(length_scale: Array | float, nu: float) -> Kernel:
    """Return the Matern kernel of smoothness 1/2, 3/2, 5/2, or infinity: ``exp(-d^2 / 2)``, d in length-scales."""

    def squared_exponential(Z: Array, X: Array) -> tuple[Array, Slopes]:
        K = np.exp(-0.5 * scipy.spatial.distance.cdist(Z / length_scale, X / length_scale, "sqeuclidean"))
        return K, lambda: [(K, 1.0, np.asarray(length_scale) ** -2.0)]

    def kernel(Z: Array, X: Array) -> tuple[Array, Slopes]:
        r = np.sqrt(2 * nu) * scipy.spatial.distance.cdist(Z / length_scale, X / length_scale)
        decay = np.exp(-r)
        polynomial = {0.5: 1.0, 1.5: 1 + r, 2.5: 1 + r + r**2 / 3}[nu]

        def slopes() -> list[Slope]:
            # At a centre, the kernel of smoothness 1/2 has a kink and no derivative.
            pole = np.divide(decay, r, out=np.zeros_like(r), where=r > 0) if nu == 0.5 else 0.0
            factor = {0.5: pole, 1.5: 3 * decay, 2.5: 5 / 3 * (1 + r) * decay}[nu]
            return [(factor, 1.0, np.asarray(length_scale) ** -2.0)]

        return polynomial * decay, slopes

    return squared_exponential if nu == np.inf else kernel
