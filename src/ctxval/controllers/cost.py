"""The quadratic cost that LQR and iLQR minimise."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_weight
from ctxval._util.representation import ShortRepr
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError


class QuadraticCost(ShortRepr):
    """The cost ``1/2 sum_t (x_t - r_t)' Q (x_t - r_t) + u_t' R u_t``, with ``Q_final`` instead of Q at the horizon.

    Args:
        Q: weight of the state, as a diagonal ``(n,)`` or a matrix ``(n, n)``.
        R: weight of the input, as a diagonal ``(m,)`` or a matrix ``(m, m)``; positive definite.
        Q_final: weight of the last state, in the same form as Q; Q by default.
    """

    def __init__(self, Q: ArrayLike, R: ArrayLike, Q_final: ArrayLike | None = None) -> None:
        self.Q = as_weight("Q", Q)
        self.R = as_weight("R", R)
        self.Q_final = self.Q if Q_final is None else as_weight("Q_final", Q_final)
        if np.linalg.eigvalsh(self.R).min() <= 0:
            raise InputError(f"R must be positive definite, got {self.R.tolist()}.")
        if self.Q_final.shape != self.Q.shape:
            raise ShapeError(f"Q_final must have the shape of Q, {self.Q.shape}, got {self.Q_final.shape}.")

    def require_task(self, task: Task) -> None:
        """Check that the task has as many states as Q."""
        n = task.initial_state.shape[-1]
        if len(self.Q) != n:
            raise ShapeError(f"Q must weigh the task's {n} states, got shape {self.Q.shape}.")

    def value(self, deviations: Array, inputs: Array) -> Array:
        """Return the cost, shape ``(...)``, of deviations ``(H+1, ..., n)`` and inputs ``(H, ..., m)``."""
        running = deviations[:-1]
        final = deviations[-1]
        cost = ((running @ self.Q) * running).sum(axis=(0, -1)) + ((inputs @ self.R) * inputs).sum(axis=(0, -1))
        return np.asarray(0.5 * (cost + ((final @ self.Q_final) * final).sum(axis=-1)))
