"""Controllers, and what designs them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from ctxval.arrays import Array
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
class AffineFeedback:
    """Time-varying affine feedback ``u = v_t + K_t (x - x_t)``.

    Attributes:
        gains: K, shape ``(..., H, m, n)``, or ``(H, m, n)`` where the whole batch has the same.
        inputs: v, shape ``(..., H, m)``.
        states: x, shape ``(..., H, n)`` or more.
    """

    gains: Array
    inputs: Array
    states: Array

    def __call__(self, t: int, x: Array) -> Array:
        """Return the input at step t, shape ``(..., m)``."""
        deviation = x - self.states[..., t, :]
        return self.inputs[..., t, :] + (self.gains[..., t, :, :] @ deviation[..., None])[..., 0]

    def __getitem__(self, index: int) -> AffineFeedback:
        """Return the controller of one task of the batch."""
        gains = self.gains[index] if self.gains.ndim > 3 else self.gains
        return AffineFeedback(gains, self.inputs[index], self.states[index])


class Policy:
    """The same policy for every task: ``policy(t, x, task) -> u``, as a synthesizer.

    Args:
        policy: called with the step index, states ``(..., n)`` and the task; returns inputs ``(..., m)``.
    """

    batched = True

    def __init__(self, policy: Callable[[int, Array, Task], Array]) -> None:
        self.policy = policy

    def design(self, task: Task, model: Model) -> Controller:
        """Return the policy bound to the task; the model is not asked."""
        return lambda t, x: np.asarray(self.policy(t, x, task), dtype=np.float64)
