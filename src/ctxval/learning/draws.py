"""Draws of the dynamics: models ``M + r_s``, which are run together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.learning.kernel_expansion import KernelExpansion
from ctxval.learning.residual_data import ResidualData


@dataclass(frozen=True, eq=False)
class DynamicsDraws(ShortRepr):
    """S models ``M + r_s``, run together: a draw is the first axis of states and inputs.

    Attributes:
        expansions: functions r_s, in groups that share their centres.
        left_out: share of the posterior variance that the draws of each group leave out between pivots.
        limit: the largest standardised residual of each learned state, in magnitude; None if there is no limit.
    """

    model: Model
    data: ResidualData
    expansions: tuple[KernelExpansion, ...]
    left_out: tuple[float, ...]
    limit: Array | None = None

    def __len__(self) -> int:
        return sum(len(one.weights) for one in self.expansions)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, shapes ``(S, q, n), (S, q, m) -> (S, q, n)``."""
        with np.errstate(all="ignore"):
            z = bounded(self.data.standardised(x, u))
            residuals, learned, first = np.zeros_like(x), self.data.learned, 0
            for one in self.expansions:
                last = first + len(one.weights)
                values = one(z[first:last])
                if self.limit is not None:
                    np.clip(values, -self.limit, self.limit, out=values)
                residuals[first:last, :, learned] = values
                first = last
            return self.model.step(x, u) + residuals * self.data.units

    def between(self, first: int, last: int) -> DynamicsDraws:
        """Return the draws from ``first`` up to and without ``last``."""
        groups, left_out, start = [], [], 0
        for one, left in zip(self.expansions, self.left_out, strict=True):
            own = slice(max(first - start, 0), max(last - start, 0))
            start += len(one.weights)
            if len(one.weights[own]):
                groups.append(one[own])
                left_out.append(left)
        return replace(self, expansions=tuple(groups), left_out=tuple(left_out))

    def __getitem__(self, index: int) -> DynamicsDraws:
        """Return one draw."""
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} draws.")
        return self.between(index, index + 1)

    def model_of(self, index: int) -> DrawnModel:
        """Return one draw as a model."""
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
