"""Differentiable functions of rows, from which the formulas of fitted regressors are composed.

Derivatives are pulled back from the outputs to the inputs (reverse mode): a model has fewer outputs than inputs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from ctxval._util.arrays import Array

PullBack = Callable[[Array], Array]
"""Maps derivatives by the values of a map, ``(N, p, o)``, to derivatives by its rows, ``(N, p, k)``."""


class SmoothMap(ABC):
    """A function from rows ``(N, k)`` to values ``(N, o)``; its derivative is the same everywhere if it is constant."""

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""
        return False

    @abstractmethod
    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values ``(N, o)`` at rows ``(N, k)``, and what pulls derivatives back to the rows."""

    def value(self, Z: Array) -> Array:
        """Return the values ``(N, o)`` at rows ``(N, k)``."""
        return self.linearised(Z)[0]

    def jacobian(self, Z: Array) -> Array:
        """Return the derivatives ``(N, o, k)`` at rows ``(N, k)``."""
        values, pull_back = self.linearised(Z)
        count, outputs = values.shape
        return pull_back(np.broadcast_to(np.eye(outputs), (count, outputs, outputs)))


@dataclass(frozen=True, eq=False)
class Affine(SmoothMap):
    """The map ``z W + b``, with W of shape ``(k, o)`` and b of shape ``(o,)``."""

    W: Array
    b: Array

    constant = True

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values, and G W'."""
        return np.asarray(Z @ self.W + self.b), lambda G: np.asarray(G @ self.W.T)


@dataclass(frozen=True, eq=False)
class Scaled(SmoothMap):
    """The map ``scale * z + shift`` of each column; both are numbers, or have shape ``(k,)``."""

    scale: Array | float
    shift: Array | float

    constant = True

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values, and G times the scale."""
        return np.asarray(self.scale * Z + self.shift), lambda G: np.asarray(G * self.scale)


@dataclass(frozen=True, eq=False)
class Monomials(SmoothMap):
    """The products of powers of the columns, such as those of polynomial features.

    Attributes:
        powers: the power of each column in each product, integers of shape ``(o, k)``.
    """

    powers: Array

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""
        return bool((self.powers.sum(axis=1) <= 1).all())

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values, and what pulls derivatives back to the rows."""
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
        products = np.ones((table.shape[1], len(powers)), dtype=table.dtype)
        for j in np.flatnonzero(powers.any(axis=0)):
            products *= table[powers[:, j], :, j].T
        return products


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
class Network(SmoothMap):
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

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values, and what pulls derivatives back to the rows."""
        function, slope = ACTIVATIONS[self.activation]
        hidden: list[Array] = []
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            Z = function(Z @ weight + bias)
            hidden.append(Z)

        def pull_back(G: Array) -> Array:
            G = G @ self.weights[-1].T
            for units, weight in zip(reversed(hidden), reversed(self.weights[:-1]), strict=True):
                G = G * slope(units)[:, None, :]
                # One product of two matrices is far faster than one for each row.
                G = (G.reshape(-1, G.shape[-1]) @ weight.T).reshape(*G.shape[:2], -1)
            return G

        return Z @ self.weights[-1] + self.biases[-1], pull_back


@dataclass(frozen=True, eq=False)
class Chain(SmoothMap):
    """Several maps, one after the other."""

    parts: Sequence[SmoothMap]

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""
        return all(part.constant for part in self.parts)

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values, and what pulls derivatives back to the rows."""
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
class SideBySide(SmoothMap):
    """Several maps of the same rows, whose values are joined."""

    parts: Sequence[SmoothMap]

    @property
    def constant(self) -> bool:
        """Whether the derivative is the same everywhere."""
        return all(part.constant for part in self.parts)

    def linearised(self, Z: Array) -> tuple[Array, PullBack]:
        """Return the values, and what pulls derivatives back to the rows."""
        values, pulls = zip(*(part.linearised(Z) for part in self.parts), strict=True)
        ends = np.cumsum([part.shape[1] for part in values])

        def pull_back(G: Array) -> Array:
            pieces = np.split(G, ends[:-1], axis=2)
            return np.asarray(np.sum([pull(piece) for pull, piece in zip(pulls, pieces, strict=True)], axis=0))

        return np.concatenate(values, axis=1), pull_back
