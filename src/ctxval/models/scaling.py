"""Models of the increment of the state: a scaling around a regressor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError
from ctxval.models.smooth_maps import SmoothMap


@dataclass(frozen=True, eq=False)
class IncrementScaling(ShortRepr):
    """The model ``x_next = x + shift_out + scale_out * f(((x, u) - shift_in) / scale_in)`` around a regressor f."""

    shift_in: Array  # of the state-input pair (n + m,)
    scale_in: Array
    shift_out: Array  # of the increment (n,)
    scale_out: Array

    @classmethod
    def of(cls, data: Transitions) -> IncrementScaling:
        """Return the scaling that gives recorded transitions zero mean and unit variance."""
        require_finite(data)
        pairs, increments = np.concatenate([data.x, data.u], axis=1), data.x_next - data.x
        shift_in, shift_out = pairs.mean(axis=0), increments.mean(axis=0)
        return cls(shift_in, standard_deviations(pairs), shift_out, standard_deviations(increments))

    def inputs(self, x: Array, u: Array) -> Array:
        """Return the inputs of f, shape ``(..., n + m)``, for states ``(..., n)`` and inputs ``(..., m)``."""
        return standardised_pairs(x, u, self.shift_in, self.scale_in)

    def targets(self, data: Transitions) -> Array:
        """Return the target outputs of f for recorded transitions, shape ``(N, n)``."""
        return (data.x_next - data.x - self.shift_out) / self.scale_out


class IncrementModel(ShortRepr, ABC):
    """A model with a Jacobian, from a scaling and a differentiable map of standardised pairs."""

    scaling: IncrementScaling

    @property
    @abstractmethod
    def _map(self) -> SmoothMap:
        """The map from standardised pairs ``(N, n + m)`` to standardised increments ``(N, n)``."""

    def step(self, x: Array, u: Array) -> Array:
        z = self.scaling.inputs(x, u)
        outputs = self._map.value(rows_of(z)).reshape(*z.shape[:-1], len(self.scaling.shift_out))
        return x + self.scaling.shift_out + self.scaling.scale_out * outputs

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        z, n = self.scaling.inputs(x, u), len(self.scaling.shift_out)
        gradient = self._map.expanded(rows_of(z))[1].reshape(*z.shape[:-1], n, z.shape[-1])
        whole = self.scaling.scale_out[:, None] * gradient / self.scaling.scale_in
        whole[..., :n] += np.eye(n)
        return whole[..., :n], whole[..., n:]

    def __getstate__(self) -> dict[str, Any]:
        # The map has functions that cannot be pickled; another process makes its own.
        return {name: value for name, value in vars(self).items() if name != "_map"}


def require_finite(data: Transitions) -> None:
    """Refuse transitions from which nothing can be learned."""
    if not len(data) or not all(np.isfinite(part).all() for part in (data.x, data.u, data.x_next)):
        raise InputError("a model needs finite transitions to be learned from, got none, NaN or infinity.")


def standardised_pairs(x: Array, u: Array, shift: Array, scale: Array) -> Array:
    """Return ``((x, u) - shift) / scale``, shape ``(..., n + m)``, for states ``(..., n)`` and inputs ``(..., m)``."""
    batch = x.shape[:-1] if x.shape[:-1] == u.shape[:-1] else np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
    n = x.shape[-1]
    z = np.empty((*batch, n + u.shape[-1]))
    z[..., :n], z[..., n:] = x, u
    if z.shape[-1:] != shift.shape:
        got = f"{n} states and {u.shape[-1]} inputs"
        raise ShapeError(f"the model has {len(shift)} states and inputs together, got {got}.")
    z -= shift
    z /= scale
    return z


def standard_deviations(columns: Array) -> Array:
    """Return the standard deviations, and 1 for a column that does not vary."""
    deviations = columns.std(axis=0)
    return np.where(deviations > 1e-12 * np.maximum(1.0, np.abs(columns).max(axis=0)), deviations, 1.0)
