"""The quadratic cost that LQR and iLQR minimise, and its gains on linear models without limits."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_weight
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Limits, LimitsLike
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError


class QuadraticCost(ShortRepr):
    """The cost ``1/2 sum_t (x_t - r_t)' Q (x_t - r_t) + u_t' R u_t``, with ``Q_final`` instead of Q at the horizon.

    Weights are diagonals or matrices; R is positive definite, and Q_final is Q by default.
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
        n = task.initial_state.shape[-1]
        if len(self.Q) != n:
            raise ShapeError(f"Q must weigh the task's {n} states, got shape {self.Q.shape}.")
        task.require_width(n)

    def value(self, deviations: Array, inputs: Array) -> Array:
        """Return the cost, shape ``(...)``, of deviations ``(H+1, ..., n)`` and inputs ``(H, ..., m)``."""
        running = deviations[:-1]
        final = deviations[-1]
        cost = ((running @ self.Q) * running).sum(axis=(0, -1)) + ((inputs @ self.R) * inputs).sum(axis=(0, -1))
        return np.asarray(0.5 * (cost + ((final @ self.Q_final) * final).sum(axis=-1)))


class QuadraticSynthesizer(ShortRepr):
    """What synthesizers of a quadratic cost have in common: the cost, and the limits of the inputs if there are any."""

    batched = True

    def __init__(self, cost: QuadraticCost, limits: LimitsLike | None) -> None:
        self.cost = cost
        self.limits = None if limits is None else Limits.of(limits, len(cost.R))

    def describe(self) -> dict[str, Any]:
        return {"cost": self.cost, **({} if self.limits is None else {"limits": self.limits})}


@dataclass(frozen=True, eq=False)
class LinearGains:
    """The Riccati recursion of ``x_next = A x + B u`` over H steps, as read-only arrays.

    The gains K_t ``(H, m, n)`` of ``u = K_t x + k_t``, the inverses ``(H, m, m)`` of ``R + B'P_{t+1}B``, the closed
    loops ``A + B K_t``, and the curvatures P_{t+1} of the cost-to-go ``1/2 x'P x``.
    """

    gains: Array
    inverses: Array
    closed: Array
    curvatures: Array


def linear_gains(cost: QuadraticCost, A: Array, B: Array, horizon: int) -> LinearGains:
    """Return the gains for a linear model, which depend on the horizon but not on the task.

    They are kept for the next design, which then computes only what depends on its tasks. The numbers themselves are
    the key, not the model, so a model that is changed in place gets gains of its own.
    """
    parts = (A, B, cost.Q, cost.R, cost.Q_final)
    contents = tuple(np.ascontiguousarray(part, dtype=np.float64).tobytes() for part in parts)
    return _recursion(contents, B.shape, horizon)


@functools.lru_cache(maxsize=16)  # enough for M and its variants in one campaign
def _recursion(contents: tuple[bytes, ...], shape: tuple[int, int], horizon: int) -> LinearGains:
    """Solve the Riccati recursion backwards, for the contents of A, B, Q, R and Q_final."""
    n, m = shape
    shapes = (n, n), (n, m), (n, n), (m, m), (n, n)
    A, B, Q, R, P = (np.frombuffer(part).reshape(size) for part, size in zip(contents, shapes, strict=True))
    steps: list[tuple[Array, Array, Array, Array]] = []
    for _ in range(horizon):
        PB = P @ B
        inverse: Array = np.asarray(np.linalg.inv(R + B.T @ PB), dtype=np.float64)
        K = -inverse @ (PB.T @ A)
        closed = A + B @ K
        steps.append((K, inverse, closed, P))
        P = Q + A.T @ P @ closed
        P = 0.5 * (P + P.T)
    gains = [np.stack(parts[::-1]) for parts in zip(*steps, strict=True)]
    for array in gains:
        array.flags.writeable = False  # many controllers share it
    return LinearGains(*gains)
