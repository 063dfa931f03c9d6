"""Draws of the dynamics: models ``M + r_s``, which are run together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows, rows_of
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.learning.kernel_expansion import KernelExpansion
from ctxval.learning.residual_data import ResidualData


@dataclass(frozen=True, eq=False)
class DynamicsDraws(ShortRepr):
    """S models ``M + r_s``, run together: a draw is the first axis of states and inputs; a single draw is a model."""

    model: Model
    data: ResidualData
    expansions: tuple[KernelExpansion, ...]  # functions r_s, in groups that are evaluated together
    left_out: float = 0.0  # largest share of the posterior variance that draws leave out between pivots
    # the largest standardised residual of each learned state, in magnitude; None if there is no limit
    limit: Array | None = None

    def __len__(self) -> int:
        return sum(len(expansion.weights) for expansion in self.expansions)

    def __getitem__(self, rows: ArrayLike) -> DynamicsDraws:
        """Return some draws; their rows are in ascending order."""
        rows = np.atleast_1d(np.asarray(rows, dtype=np.intp))
        if not (rows < len(self)).all():
            raise IndexError(f"there are {len(self)} draws.")
        if len(rows) == len(self):
            return self
        firsts = np.cumsum([0, *(len(each.weights) for each in self.expansions)])
        chosen = [rows[(rows >= first) & (rows < last)] - first for first, last in pairwise(firsts)]
        kept = tuple(each[some] for each, some in zip(self.expansions, chosen, strict=True) if len(some))
        return replace(self, expansions=kept)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, shapes ``(S, q, n), (S, q, m) -> (S, q, n)``; of a single draw ``(..., n)``."""
        shape = x.shape
        if len(self) == 1:
            x, u = rows_of(x)[None], rows_of(u)[None]
        with np.errstate(all="ignore"):
            z = bounded(self.data.standardised(x, u))
            parts = np.split(z, np.cumsum([len(each.weights) for each in self.expansions[:-1]], dtype=int))
            learned = np.concatenate([each(part) for each, part in zip(self.expansions, parts, strict=True)])
            if self.limit is not None:
                learned = np.minimum(np.maximum(learned, -self.limit), self.limit)
            residuals = np.zeros_like(x)
            residuals[:, :, self.data.learned] = learned
            return (self.model.step(x, u[..., : self.data.inputs]) + residuals * self.data.units).reshape(shape)


@dataclass(frozen=True, eq=False)
class DisturbedDynamics(ShortRepr):
    """One model, to whose next states something is added, in several ways that are run together as draws are."""

    mean: DynamicsDraws  # the model, as the only draw
    ways: Rows  # numbers of the ways, (S,)
    # what is added for ways (S,) at states (S, q, n), in a shape that broadcasts to theirs
    added: Callable[[Rows, Array], Array]

    def __len__(self) -> int:
        return len(self.ways)

    def __getitem__(self, rows: ArrayLike) -> DisturbedDynamics:
        """Return some of the ways."""
        return replace(self, ways=self.ways[np.atleast_1d(rows)])

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, shapes ``(S, q, n), (S, q, m) -> (S, q, n)``; of a single way ``(..., n)``."""
        together = x if len(self) > 1 else rows_of(x)[None]
        moved = self.mean.step(x, u).reshape(together.shape) + self.added(self.ways, together)
        return np.asarray(moved.reshape(x.shape))


def bounded(z: Array) -> Array:
    """Return standardised pairs within limits, in the same array: a loop that diverges stays finite; NaN becomes 0."""
    np.maximum(z, -1e6, out=z)
    np.minimum(z, 1e6, out=z)
    z[np.isnan(z)] = 0.0
    return z
