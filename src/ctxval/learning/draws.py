"""Draws of the dynamics: models ``M + r_s``, which are run together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, rows_of
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
        return sum(len(one.weights) for one in self.expansions)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, shapes ``(S, q, n), (S, q, m) -> (S, q, n)``."""
        with np.errstate(all="ignore"):
            z = bounded(self.data.standardised(x, u))
            values = [one(z[first:last]) for one, first, last in self._groups()]
            learned = values[0] if len(values) == 1 else np.concatenate(values)
            if self.limit is not None:
                learned = np.minimum(np.maximum(learned, -self.limit), self.limit)
            residuals = np.zeros_like(x)
            residuals[:, :, self.data.learned] = learned
            return self.model.step(x, u[..., : self.data.inputs]) + residuals * self.data.units

    def reduced(self, distances: Array) -> Array:
        """Return the distances ``(S, q)`` of draws from those of their loops, of which each draw has one."""
        return distances

    def alone(self, x: Array, u: Array) -> Array:
        """Return the next states ``(..., n)`` of the only one of some draws."""
        return np.asarray(DynamicsDraws.step(self, rows_of(x)[None], rows_of(u)[None]).reshape(x.shape))

    def __getitem__(self, rows: ArrayLike) -> DynamicsDraws:
        """Return some draws; their rows are in ascending order."""
        rows = np.atleast_1d(np.asarray(rows, dtype=np.intp))
        if len(rows) == len(self):
            return self
        chosen = [(one, rows[(rows >= first) & (rows < last)] - first) for one, first, last in self._groups()]
        return replace(self, expansions=tuple(one[own] for one, own in chosen if len(own)))

    def _groups(self) -> list[tuple[KernelExpansion, int, int]]:
        """Return the expansions with the rows of their first draw and of the one after their last."""
        ends = np.cumsum([len(one.weights) for one in self.expansions]).tolist()
        return list(zip(self.expansions, [0, *ends], ends, strict=False))

    def model_of(self, index: int) -> DrawnModel:
        """Return one draw as a model."""
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} draws.")
        return DrawnModel(self[index])


def bounded(z: Array) -> Array:
    """Return standardised pairs within limits, in the same array: a loop that diverges stays finite; NaN becomes 0."""
    np.maximum(z, -1e6, out=z)
    np.minimum(z, 1e6, out=z)
    z[np.isnan(z)] = 0.0
    return z


class DrawnModel:
    """The model ``M + r_s`` of the only one of some draws."""

    def __init__(self, draws: DynamicsDraws) -> None:
        self._draws = draws

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return np.asarray(self._draws.step(rows_of(x)[None], rows_of(u)[None]).reshape(x.shape))
