"""Gains of linear models without limits, which depend on the model, the weights and the horizon, but not on the task.

They are kept for the next design. A design for each of many suggestions then computes only what depends on its tasks.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval.controllers.cost import QuadraticCost


@dataclass(frozen=True, eq=False)
class LinearGains:
    """The Riccati recursion of ``x_next = A x + B u`` over H steps, as read-only arrays.

    Attributes:
        gains: K_t of ``u = K_t x + k_t``, shape ``(H, m, n)``.
        inverses: the inverses of ``R + B'P_{t+1}B``, shape ``(H, m, m)``.
        closed: ``A + B K_t``, shape ``(H, n, n)``.
        curvatures: P_{t+1} of the cost-to-go ``1/2 x'P x``, shape ``(H, n, n)``.
    """

    gains: Array
    inverses: Array
    closed: Array
    curvatures: Array


def linear_gains(cost: QuadraticCost, A: Array, B: Array, horizon: int) -> LinearGains:
    """Return the gains for a linear model; a second call with equal numbers returns the same object.

    The numbers themselves are the key, not the model, so a model that is changed in place gets gains of its own.
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
