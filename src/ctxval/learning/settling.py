"""Models whose steps settle around what M misses: ``x' = settle(M(x, a) + r(x, a))``, as with dry friction.

What settles a step depends on the residual r, and some steps do not teach r, such as those of joints that are held.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Mask, Rows
from ctxval.core.model import Model
from ctxval.core.state_geometry import StateGeometry, geometry_of
from ctxval.core.trajectory import Transitions


class SettlingModel(ABC):
    """M with what settles its steps, which may differ in draws of the dynamics."""

    given: Model  #: M without it
    rates: Rows  #: the states by which it is judged: how it changes others is little, and nothing predicts it

    @property
    def geometry(self) -> StateGeometry:
        """The geometry of the states of M."""
        return geometry_of(self.given)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return self.following(x, u, lambda acting: np.zeros_like(x))

    @abstractmethod
    def following(self, x: Array, u: Array, missed: Callable[[Array], Array]) -> Array:
        """Return the next states ``(..., n)`` if M misses ``missed(acting inputs)``, which has their shape."""

    @abstractmethod
    def teaching(self, transitions: Transitions) -> tuple[Transitions, Mask]:
        """Return transitions with the inputs that act, and which of them teach what M misses ``(N,)``."""

    @abstractmethod
    def told_by(self, steps: Transitions, missed: Callable[[Array, Array], Array]) -> Self:
        """Return the same with the bounds of what steps leave open, if M misses ``missed(states, acting inputs)``."""

    @abstractmethod
    def between(self, shares: ArrayLike) -> Self:
        """Return what differs in draws, at shares ``(S,)`` of the way from the least to the largest that is open."""

    @abstractmethod
    def __getitem__(self, rows: ArrayLike) -> Self:
        """Return what differs in some draws."""
