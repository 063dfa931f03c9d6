"""Differentiable functions of rows, from which the formulas of fitted regressors are composed.

Derivatives are pulled back from the outputs to the inputs (reverse mode): a model has fewer outputs than inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import expit

from ctxval._util.arrays import Array

PullBack = Callable[[Array], Array]
"""Maps derivatives by the values of a map, ``(N, p, o)``, to derivatives by its rows, ``(N, p, k)``."""


class SmoothMap(Protocol):
    """A function from rows ``(N, k)`` to values ``(N, o)``."""

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values ``(N, o)`` at rows ``(N, k)``, and what pulls derivatives back to the rows."""


def jacobian(smooth: SmoothMap, Z: Array) -> Array:
    """Return the derivatives ``(N, o, k)`` of a map at rows ``(N, k)``."""
    values, pull_back = smooth.linearised(Z)
    count, outputs = values.shape
    return pull_back(np.broadcast_to(np.eye(outputs), (count, outputs, outputs)))


@dataclass(frozen=True, eq=False)
class Affine:
    """The map ``z W + b``, with W of shape ``(k, o)`` and b of shape ``(o,)``."""

    W: Array
    b: Array

    constant = True

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""
        return np.asarray(Z @ self.W + self.b)

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values at rows ``(N, k)``, and what pulls derivatives back to the rows."""
        return self.value(Z), lambda G: np.asarray(G @ self.W.T)


@dataclass(frozen=True, eq=False)
class Scaled:
    """The map ``scale * z + shift`` of each column; both are numbers, or have shape ``(k,)``."""

    scale: Array | float
    shift: Array | float

    constant = True

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""
        return np.asarray(self.scale * Z + self.shift)

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values at rows ``(N, k)``, and what pulls derivatives back to the rows."""
        return self.value(Z), lambda G: np.asarray(G * self.scale)


@dataclass(frozen=True, eq=False)
class Monomials:
    """The products of powers of the columns, such as those of polynomial features.

    Attributes:
        powers: the power of each column in each product, integers of shape ``(o, k)``.
    """

    powers: Array

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""
        return bool((self.powers.sum(axis=1) <= 1).all())

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""
        return self._products(self._table(Z), self.powers)

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values at rows ``(N, k)``, and what pulls derivatives back to the rows."""
        table = self._table(Z)

        def pull_back(G: Array) -> Array:
            columns = []
            for j in range(Z.shape[1]):
                with_j = np.flatnonzero(self.powers[:, j])
                lower = self.powers[with_j].copy()
                lower[:, j] -= 1
                slopes = self.powers[with_j, j] * self._products(table, lower)
                columns.append((G[:, :, with_j] @ slopes[:, :, None])[..., 0])
            return np.stack(columns, axis=-1)

        return self._products(table, self.powers), pull_back

    def _table(self, Z: Array) -> Array:
        """Return the powers of the columns from 0 to the largest, shape ``(largest + 1, N, k)``."""
        table = np.ones((int(self.powers.max(initial=0)) + 1, *Z.shape), dtype=Z.dtype)
        for power in range(1, len(table)):
            table[power] = table[power - 1] * Z
        return table

    def _products(self, table: Array, powers: Array) -> Array:
        found = np.ones((table.shape[1], len(powers)), dtype=table.dtype)
        for j in np.flatnonzero(powers.any(axis=0)):
            found *= table[powers[:, j], :, j].T
        return found


Activation = tuple[Callable[[Array], Array], Callable[[Array], Array]]
"""A function of the units, and its derivative as a function of its own value."""

ACTIVATIONS: dict[str, Activation] = {
    "identity": (lambda z: z, np.ones_like),
    "logistic": (expit, lambda a: a * (1 - a)),
    "tanh": (np.tanh, lambda a: 1 - a * a),
    "relu": (lambda z: np.maximum(z, 0), lambda a: (a > 0).astype(np.float64)),
}
"""The functions of units of networks by scikit-learn's names. At its kink, a ReLU counts as inactive."""


@dataclass(frozen=True, eq=False)
class Network:
    """A feedforward network with a linear last layer.

    Attributes:
        weights: one matrix for each layer, shapes ``(k, h), (h, h'), ...``.
        biases: one vector for each layer.
        activation: the function of the hidden units, a name of ``ACTIVATIONS``.
    """

    weights: Sequence[Array]
    biases: Sequence[Array]
    activation: str

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""
        return self.activation == "identity" or len(self.weights) == 1

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""
        return self._layers(Z)[-1]

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values at rows ``(N, k)``, and what pulls derivatives back to the rows."""
        *hidden, output = self._layers(Z)
        slope = ACTIVATIONS[self.activation][1]

        def pull_back(G: Array) -> Array:
            G = G @ self.weights[-1].T
            for units, weight in zip(reversed(hidden), reversed(self.weights[:-1]), strict=True):
                G = G * slope(units)[:, None, :]
                # One product of two matrices is far faster than one for each row.
                G = (G.reshape(-1, G.shape[-1]) @ weight.T).reshape(*G.shape[:2], -1)
            return G

        return output, pull_back

    def _layers(self, Z: Array) -> list[Array]:
        """Return the units of each hidden layer, and the output."""
        function, found = ACTIVATIONS[self.activation][0], []
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            Z = function(Z @ weight + bias)
            found.append(Z)
        return [*found, Z @ self.weights[-1] + self.biases[-1]]


@dataclass(frozen=True, eq=False)
class Chain:
    """Several maps, one after the other."""

    parts: Sequence[SmoothMap]

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""
        return all(part.constant for part in self.parts)

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""
        for part in self.parts:
            Z = part.value(Z)
        return Z

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values at rows ``(N, k)``, and what pulls derivatives back to the rows."""
        pulls: list[PullBack] = []
        for part in self.parts:
            Z, pull = part.linearised(Z)
            pulls.append(pull)

        def pull_back(G: Array) -> Array:
            for pull in reversed(pulls):
                G = pull(G)
            return G

        return Z, pull_back


@dataclass(frozen=True, eq=False)
class SideBySide:
    """Several maps of the same rows, whose values are joined."""

    parts: Sequence[SmoothMap]

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""
        return all(part.constant for part in self.parts)

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""
        return np.concatenate([part.value(Z) for part in self.parts], axis=1)

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values at rows ``(N, k)``, and what pulls derivatives back to the rows."""
        found = [part.linearised(Z) for part in self.parts]
        ends = np.cumsum([values.shape[1] for values, _ in found])

        def pull_back(G: Array) -> Array:
            pieces = np.split(G, ends[:-1], axis=2)
            return np.asarray(np.sum([pull(piece) for (_, pull), piece in zip(found, pieces, strict=True)], axis=0))

        return np.concatenate([values for values, _ in found], axis=1), pull_back
