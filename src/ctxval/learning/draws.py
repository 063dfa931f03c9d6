"""Draws of the dynamics: models ``M + r_s``, which are run together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows, rows_of
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.learning.kernel_expansion import KernelExpansion
from ctxval.learning.residual_data import ResidualData


@dataclass(frozen=True, eq=False)
class DynamicsDraws(ShortRepr):
    """S models ``M + r_s``, run together: a draw is the first axis of states and inputs.

    Attributes:
        expansions: functions r_s, in groups that are evaluated together.
        left_out: largest share of the posterior variance that draws leave out between pivots.
        limit: the largest standardised residual of each learned state, in magnitude; None if there is no limit.
    """

    model: Model
    data: ResidualData
    expansions: tuple[KernelExpansion, ...]
    left_out: float = 0.0
    limit: Array | None = None

    def __len__(self) -> int:
        return sum(len(expansion.weights) for expansion in self.expansions)

    def __getitem__(self, rows: ArrayLike) -> DynamicsDraws:
        """Return some draws; their rows are in ascending order."""
        rows = np.atleast_1d(np.asarray(rows, dtype=np.intp))
        if len(rows) == len(self):
            return self
        chosen = [(each, rows[(rows >= first) & (rows < last)] - first) for each, first, last in self._groups()]
        return replace(self, expansions=tuple(each[own] for each, own in chosen if len(own)))

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, shapes ``(S, q, n), (S, q, m) -> (S, q, n)``."""
        with np.errstate(all="ignore"):
            z = bounded(self.data.standardised(x, u))
            values = [expansion(z[first:last]) for expansion, first, last in self._groups()]
            learned = values[0] if len(values) == 1 else np.concatenate(values)
            if self.limit is not None:
                learned = np.minimum(np.maximum(learned, -self.limit), self.limit)
            residuals = np.zeros_like(x)
            residuals[:, :, self.data.learned] = learned
            return self.model.step(x, u[..., : self.data.inputs]) + residuals * self.data.units

    def _groups(self) -> list[tuple[KernelExpansion, int, int]]:
        """Return the expansions with the rows of their first draw and of the one after their last."""
        ends = np.cumsum([len(expansion.weights) for expansion in self.expansions]).tolist()
        return list(zip(self.expansions, [0, *ends], ends, strict=False))

    def model_of(self, index: int) -> DrawnModel:
        """Return one draw as a model."""
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} draws.")
        return DrawnModel(self[index])

    def alone(self, x: Array, u: Array) -> Array:
        """Return the next states ``(..., n)`` of the only one of some draws."""
        return DrawnModel(self).step(x, u)


@dataclass(frozen=True, eq=False)
class DisturbedDynamics(ShortRepr):
    """One model, to whose next states something is added, in several ways that are run together as draws are.

    Attributes:
        mean: the model, as the only draw.
        ways: numbers of the ways, shape ``(S,)``.
        added: what is added for ways ``(S,)`` at states ``(S, q, n)``, in a shape that broadcasts to theirs.
    """

    mean: DynamicsDraws
    ways: Rows
    added: Callable[[Rows, Array], Array]

    def __len__(self) -> int:
        return len(self.ways)

    def __getitem__(self, rows: ArrayLike) -> DisturbedDynamics:
        """Return some of the ways."""
        return replace(self, ways=self.ways[np.atleast_1d(rows)])

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, shapes ``(S, q, n), (S, q, m) -> (S, q, n)``."""
        return np.asarray(self.mean.alone(x, u) + self.added(self.ways, x))


class DrawnModel:
    """The model ``M + r_s`` of the only one of some draws."""

    def __init__(self, draws: DynamicsDraws | DisturbedDynamics) -> None:
        self._draws = draws

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return np.asarray(self._draws.step(rows_of(x)[None], rows_of(u)[None]).reshape(x.shape))


def bounded(z: Array) -> Array:
    """Return standardised pairs within limits, in the same array: a loop that diverges stays finite; NaN becomes 0."""
    np.maximum(z, -1e6, out=z)
    np.minimum(z, 1e6, out=z)
    z[np.isnan(z)] = 0.0
    return z
