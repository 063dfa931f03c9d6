"""Models that were refined: a model with a learned correction, or any model that was learned again."""

from __future__ import annotations

import functools
from dataclasses import KW_ONLY, dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from ctxval._util.arrays import Array, Mask, as_finite, rows_of
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model, advanced, linearize, memory_in
from ctxval.core.state_geometry import geometry_of
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError
from ctxval.models.increments import standardised_pairs
from ctxval.models.smooth_maps import SmoothMap, kernel_sum, matern

Linearised = Literal["corrected", "model"]  #: whose Jacobian controllers are designed with


@dataclass(frozen=True, eq=False)
class Correction(ShortRepr):
    """The correction ``r(x, u)``: a weighted sum of Matern 5/2 covariances with centres, and a linear function.

    A pair is standardised, ``z = ((x, u) - shift) / scale``. Outside the box of the recorded pairs, the correction
    fades: it is multiplied by ``exp(-1/2 sum_j (e_j / fade_j)^2)``, where e_j is the distance to the box. Far from all
    records it is zero, and the model is as before.

    Raises:
        InputError: if a scale is not positive.
        ShapeError: if the arrays do not belong together.
    """

    shift: Array  # constants of the standardised pairs (n + m,)
    scale: Array
    centres: Array  # standardised pairs (M, n + m)
    length_scales: Array  # of the covariance (n + m,)
    weights: Array  # of the covariances, in the units of the states (M, n)
    linear: Array  # slopes, and the constant as the last row (n + m + 1, n)
    low: Array  # the box of the recorded pairs, standardised (n + m,)
    high: Array
    fade: Array  # standardised distances from the box over which the correction fades (n + m,)
    limit: Array  # largest magnitude of the correction of each state (n,)

    def __post_init__(self) -> None:
        n, k, M = len(self.limit), len(self.shift), len(self.centres)
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
            as_finite(f"{name} of a correction", value)
        if min(float(scale.min()) for scale in (self.scale, self.length_scales, self.fade)) <= 0:
            raise InputError("the scales of a correction must be positive.")

    @property
    def states(self) -> int:
        return len(self.limit)

    def __call__(self, x: Array, u: Array) -> Array:
        z = standardised_pairs(x, u, self.shift, self.scale)
        rows = rows_of(z)
        values = np.clip(self._unlimited.value(rows), -self.limit, self.limit) * self._faded(rows)[:, None]
        return np.asarray(values.reshape(*z.shape[:-1], self.states))

    def jacobian(self, x: Array, u: Array) -> Array:
        z = standardised_pairs(x, u, self.shift, self.scale)
        rows = rows_of(z)
        values, slope = self._unlimited.expanded(rows)
        slope[np.abs(values) > self.limit] = 0.0
        faded = self._faded(rows)
        slope *= faded[:, None, None]
        values = np.clip(values, -self.limit, self.limit) * faded[:, None]
        slope -= values[:, :, None] * (self._beyond(rows) / self.fade**2)[:, None, :]
        return np.asarray((slope / self.scale).reshape(*z.shape[:-1], self.states, z.shape[-1]))

    @functools.cached_property
    def _unlimited(self) -> SmoothMap:
        block = max(1, 40_000 // max(1, len(self.centres)))  # whose covariances stay in the processor's cache
        kernel, scales = matern(self.length_scales), self.length_scales
        return kernel_sum(kernel, scales, self.centres, self.weights, linear=self.linear, block=block)

    def _beyond(self, rows: Array) -> Array:
        return np.asarray(rows - np.clip(rows, self.low, self.high))

    def _faded(self, rows: Array) -> Array:
        return np.asarray(np.exp(-0.5 * ((self._beyond(rows) / self.fade) ** 2).sum(axis=1)))

    def of_states(self, chosen: Mask) -> Correction:
        """Return this correction for some states ``(n,)``; that of the others is zero."""
        return replace(self, weights=np.where(chosen, self.weights, 0.0), linear=np.where(chosen, self.linear, 0.0))

    def arrays(self) -> dict[str, Array]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True, eq=False)
class Corrected(ShortRepr):
    """The model ``M'(x, u) = M(x, u) + r(x, u)`` of a model M and a correction r."""

    model: Model
    correction: Correction
    _: KW_ONLY
    #: ``"corrected"`` for the Jacobian of M', or ``"model"`` for that of M. That of M' at one point may say less of the
    #: tasks than a linear model that was fitted to all of them, for instance to LQR, which linearises once.
    linearised: Linearised = "corrected"
    data: Transitions | None = None  #: the transitions that the correction was learned from, if any

    def step(self, x: Array, u: Array) -> Array:
        return self._corrected(x, u, self.model.step(x, u))

    def start(self, x: Array) -> Array:
        """Return the memory of M at the start of closed loops in states ``(..., n)``."""
        return memory_in(self.model, x)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states and the memory of M, as :class:`ctxval.core.model.ModelWithMemory`."""
        x_next, memory = advanced(self.model, x, u, memory)
        return self._corrected(x, u, x_next), memory

    def _corrected(self, x: Array, u: Array, x_next: Array) -> Array:
        geometry = geometry_of(self.model)
        return geometry.corrected(x_next, self.correction(geometry.features(x), u), x)

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return A ``(..., n, n)`` and B ``(..., n, m)``, without batch axes if they are those of a linear model M."""
        A, B = linearize(self.model, x, u)
        if self.linearised == "model":
            return A, B
        slope, n = self.correction.jacobian(x, u), x.shape[-1]
        return A + slope[..., :n], B + slope[..., n:]


class Refined(ShortRepr):
    """A model that was learned again from executions, with all transitions that are known, and the model before.

    What learns from executions takes the residual of the model before, because that of the refined model would be
    misleadingly small at its own data.

    Args:
        data: all transitions that are known, those of the executions of earlier models included.
        before: the model that was refined; of a model that was refined before, the first one.
    """

    def __init__(self, model: Model, data: Transitions, before: Model) -> None:
        self.model, self.data, self.before = model, data, before_refinement(before)

    def __getattr__(self, name: str) -> Any:
        # A model without a Jacobian must not seem to have one.
        if name == "jacobian" and "model" in self.__dict__:
            return getattr(self.model, name)
        raise AttributeError(name)

    def step(self, x: Array, u: Array) -> Array:
        return self.model.step(x, u)

    def start(self, x: Array) -> Array:
        """Return the memory of the model at the start of closed loops in states ``(..., n)``."""
        return memory_in(self.model, x)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states ``(..., n)`` and the memory, as :class:`ctxval.core.model.ModelWithMemory`."""
        return advanced(self.model, x, u, memory)


def before_refinement(model: Model) -> Model:
    """Return the model whose residual is learned from executions: that before a refinement, or the model itself."""
    if isinstance(model, Refined):
        return model.before
    return model.model if isinstance(model, Corrected) else model
