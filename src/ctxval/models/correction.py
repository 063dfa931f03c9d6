"""Corrections of a model: functions of state and input that are learned from executions and added to its steps."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, replace

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError, ShapeError
from ctxval.models.kernel_maps import KernelSum, matern
from ctxval.models.scaling import standardised_pairs


@dataclass(frozen=True, eq=False)
class Correction(ShortRepr):
    """The correction ``r(x, u)``: a weighted sum of Matern 5/2 covariances with centres, and a linear function.

    A pair is standardised, ``z = ((x, u) - shift) / scale``. Outside the box of the recorded pairs, the correction
    fades: it is multiplied by ``exp(-1/2 sum_j (e_j / fade_j)^2)``, where e_j is the distance to the box. Far from all
    records it is zero, and the model is as before.

    Attributes:
        shift, scale: constants of the standardised pairs, shapes ``(n + m,)``.
        centres: standardised pairs, shape ``(M, n + m)``.
        length_scales: of the covariance, shape ``(n + m,)``.
        weights: of the covariances, in the units of the states, shape ``(M, n)``.
        linear: slopes, and the constant as the last row, shape ``(n + m + 1, n)``.
        low, high: the box of the recorded pairs, standardised, shapes ``(n + m,)``.
        fade: standardised distances from the box over which the correction fades, shape ``(n + m,)``.
        limit: largest magnitude of the correction of each state, shape ``(n,)``.
    """

    shift: Array
    scale: Array
    centres: Array
    length_scales: Array
    weights: Array
    linear: Array
    low: Array
    high: Array
    fade: Array
    limit: Array

    def __post_init__(self) -> None:
        n, k = len(self.limit), len(self.shift)
        M = len(self.centres)
        if not 0 < n <= k:
            raise ShapeError(f"a correction of pairs of {k} states and inputs has 1 to {k} states, got {n}.")
        wanted = {
            **dict.fromkeys(("shift", "scale", "length_scales", "low", "high", "fade"), (k,)),
            **{"centres": (M, k), "weights": (M, n), "linear": (k + 1, n), "limit": (n,)},
        }
        for name, shape in wanted.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ShapeError(f"{name} of a correction must have shape {shape}, got {value.shape}.")
            if not np.isfinite(value).all():
                raise InputError(f"{name} of a correction must be finite.")
        if min(float(scale.min()) for scale in (self.scale, self.length_scales, self.fade)) <= 0:
            raise InputError("the scales of a correction must be positive.")

    @property
    def states(self) -> int:
        """The number n of states."""
        return len(self.limit)

    def __call__(self, x: Array, u: Array) -> Array:
        """Return r, shapes ``(..., n), (..., m) -> (..., n)``."""
        z = standardised_pairs(x, u, self.shift, self.scale)
        rows = z.reshape(-1, z.shape[-1])
        values = rows @ self.linear[:-1] + self.linear[-1]
        for block in self._blocks(len(rows)):
            values[block] += self._kernel_sum.value(rows[block])
        values = np.clip(values, -self.limit, self.limit) * self._faded(rows)[:, None]
        return np.asarray(values.reshape(*z.shape[:-1], self.states))

    def jacobian(self, x: Array, u: Array) -> Array:
        """Return the derivatives by state and input, shape ``(..., n, n + m)``."""
        z = standardised_pairs(x, u, self.shift, self.scale)
        rows = z.reshape(-1, z.shape[-1])
        parts = [self._jacobian(rows[block]) for block in self._blocks(max(1, len(rows)))]
        return np.concatenate(parts).reshape(*z.shape[:-1], self.states, z.shape[-1])

    def _blocks(self, count: int) -> list[slice]:
        """Return blocks of rows whose 40,000 covariances stay in the processor's cache."""
        size = max(1, 40_000 // max(1, len(self.centres)))
        return [slice(first, first + size) for first in range(0, count, size)]

    def _jacobian(self, rows: Array) -> Array:
        values, pull_back = self._kernel_sum.linearised(rows)
        slope = pull_back(np.eye(self.states)) + self.linear[:-1].T
        values = values + rows @ self.linear[:-1] + self.linear[-1]
        limited: Mask = np.asarray(np.abs(values) > self.limit)
        slope[limited] = 0.0
        faded, beyond = self._faded(rows), self._beyond(rows)
        slope *= faded[:, None, None]
        values = np.clip(values, -self.limit, self.limit) * faded[:, None]
        slope -= values[:, :, None] * (beyond / self.fade**2)[:, None, :]
        return np.asarray(slope / self.scale)

    @functools.cached_property
    def _kernel_sum(self) -> KernelSum:
        covariance = matern(self.length_scales, 2.5)
        assert covariance is not None  # of this smoothness there is one
        return KernelSum(covariance, self.centres, self.weights)

    def _beyond(self, rows: Array) -> Array:
        """Return how far pairs are beyond the box of the records, with signs, shape ``(q, n + m)``."""
        return np.asarray(rows - np.clip(rows, self.low, self.high))

    def _faded(self, rows: Array) -> Array:
        return np.asarray(np.exp(-0.5 * ((self._beyond(rows) / self.fade) ** 2).sum(axis=1)))

    def of_states(self, chosen: Mask) -> Correction:
        """Return this correction for some states ``(n,)``; that of the others is zero."""
        return replace(self, weights=np.where(chosen, self.weights, 0.0), linear=np.where(chosen, self.linear, 0.0))

    def arrays(self) -> dict[str, Array]:
        """Return all arrays by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
