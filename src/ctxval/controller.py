"""Controllers, and what designs them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctxval.arrays import Array, ArrayLike, as_floats
from ctxval.errors import InputError, ShapeError
from ctxval.model import Model
from ctxval.task import Task

Controller = Callable[[int, Array], Array]
"""``u = pi(t, x)``: step index t, state ``(..., n)`` -> input ``(..., m)``."""


@runtime_checkable
class Synthesizer(Protocol):
    """Designs a controller for a task on a model.

    A synthesizer that can design for a batch of tasks in one call says so with an attribute ``batched = True``.
    """

    def design(self, task: Task, model: Model) -> Controller:
        """Return the controller pi(x; g_p, M).

        Raises:
            DesignError: there is none.
        """


@dataclass(frozen=True, eq=False)
class Limits:
    """The box that inputs stay in, ``low <= u <= high``, each shape ``(m,)``; infinite where there is no limit."""

    low: Array
    high: Array

    @classmethod
    def of(cls, limits: LimitsLike, inputs: int) -> Limits:
        """Return limits from ``(low, high)``, or from one ``high`` with ``low = -high``; numbers hold for every input.

        Raises:
            InputError: a limit is NaN, or a low one is not below its high one.
            ShapeError: there are not as many as inputs.
        """
        if isinstance(limits, Limits):
            limits = (limits.low, limits.high)
        high = as_floats("limits", limits[1] if isinstance(limits, tuple) else limits)
        low = as_floats("limits", limits[0]) if isinstance(limits, tuple) else -high
        if any(bound.shape not in ((), (inputs,)) for bound in (low, high)):
            raise ShapeError(f"limits must be numbers or have shape ({inputs},), got {low.shape} and {high.shape}.")
        low, high = (np.array(np.broadcast_to(bound, (inputs,))) for bound in (low, high))
        if not (low < high).all():
            raise InputError(f"limits must be low < high for every input, got {low.tolist()} and {high.tolist()}.")
        return cls(low, high)

    def describe(self) -> dict[str, Any]:
        """Return what identifies these limits in a store."""
        return {"low": self.low.tolist(), "high": self.high.tolist()}

    def clip(self, u: Array) -> Array:
        """Return inputs ``(..., m)`` within the limits; NaN stays NaN."""
        return np.asarray(np.clip(u, self.low, self.high))


LimitsLike = Limits | tuple[ArrayLike, ArrayLike] | ArrayLike
"""``(low, high)``, or one ``high`` that stands for ``(-high, high)``; each a number or ``(m,)``."""


@dataclass(frozen=True, eq=False)
class AffineFeedback:
    """Time-varying affine feedback ``u = v_t + K_t (x - x_t)``, clipped to its limits where it has any.

    Attributes:
        gains: K, shape ``(..., H, m, n)``, or ``(H, m, n)`` where the whole batch has the same.
        inputs: v, shape ``(..., H, m)``.
        states: x, shape ``(..., H, n)`` or more.
        limits: the same for every task of a batch.
    """

    gains: Array
    inputs: Array
    states: Array
    limits: Limits | None = None

    def __call__(self, t: int, x: Array) -> Array:
        """Return the input at step t, shape ``(..., m)``."""
        deviation = x - self.states[..., t, :]
        u = self.inputs[..., t, :] + (self.gains[..., t, :, :] @ deviation[..., None])[..., 0]
        return u if self.limits is None else self.limits.clip(u)

    def __getitem__(self, index: int) -> AffineFeedback:
        """Return the controller of one task of the batch."""
        gains = self.gains[index] if self.gains.ndim > 3 else self.gains
        return AffineFeedback(gains, self.inputs[index], self.states[index], self.limits)


class Policy:
    """The same policy for every task: ``policy(t, x, task) -> u``, as a synthesizer.

    Args:
        policy: called with the step index, states ``(..., n)`` and the task; returns inputs ``(..., m)``.
        vectorized: False where it only takes one state ``(n,)`` at a time.
        limits: inputs are clipped to ``(low, high)``, or to ``(-high, high)``: numbers, or one each input.
    """

    def __init__(
        self,
        policy: Callable[[int, Array, Task], Array],
        *,
        vectorized: bool = True,
        limits: LimitsLike | None = None,
    ) -> None:
        self.policy = policy
        self.batched = vectorized
        self.limits = limits

    def design(self, task: Task, model: Model) -> Controller:
        """Return the policy bound to the task; the model is not asked."""
        return _BoundPolicy(self.policy, task, self.limits)

    def describe(self) -> dict[str, Any]:
        """Return what identifies this synthesizer in a store."""
        return {"policy": self.policy, **({} if self.limits is None else {"limits": self.limits})}


@dataclass(frozen=True, eq=False)
class _BoundPolicy:
    """A policy for one task or a batch; unlike a lambda it can go to another process."""

    policy: Callable[[int, Array, Task], Array]
    task: Task
    limits: LimitsLike | None

    def __call__(self, t: int, x: Array) -> Array:
        u = np.asarray(self.policy(t, x, self.task), dtype=np.float64)
        return u if self.limits is None else Limits.of(self.limits, u.shape[-1]).clip(u)
