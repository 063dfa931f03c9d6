"""The backward pass of iLQR: minimisers of the quadratic expansion of the cost-to-go, for a batch of tasks.

Input limits after control-limited differential dynamic programming (Tassa, Mansard and Todorov 2014).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval.controllers.lqr import QuadraticCost, linear_gains
from ctxval.core.controller import Limits


@dataclass(frozen=True, eq=False)
class InputStep:
    """A step of the inputs with its feedback, and the expected change of the cost.

    The gains K have shape ``(H, N, m, n)``, or ``(H, m, n)`` if all tasks share them, the feedforward k ``(H, N, m)``.
    A step of some length changes the cost by ``length * slope + length^2 / 2 * curvature``, both of shape ``(N,)``.
    """

    K: Array
    k: Array
    slope: Array
    curvature: Array


@dataclass(frozen=True, eq=False)
class Expansion:
    """What the cost is expanded around, time first: N tasks with n states and m inputs.

    Deviations ``(H + 1, N, n)`` are states minus references, and inputs are ``(H, N, m)``. The derivatives A and B are
    ``(H, N, n, n)`` and ``(H, N, n, m)``, or have no leading axes if they are constant.
    """

    deviations: Array
    inputs: Array
    A: Array
    B: Array

    @property
    def linear(self) -> bool:
        return self.A.ndim == 2 and self.B.ndim == 2


def minimise(cost: QuadraticCost, around: Expansion, limits: Limits | None, damping: Array) -> InputStep:
    """Return the step that minimises the expansion, with so much damping ``(N,)``, over inputs within the limits."""
    if damping.any():
        return _recursion(cost, around, limits, damping[:, None, None] * np.eye(len(cost.R)))
    if limits is not None or not around.linear:
        return _recursion(cost, around, limits, None)
    # The gains for a linear model are known, so only the slope of the cost-to-go is computed.
    horizon, batch = around.inputs.shape[:2]
    known = linear_gains(cost, around.A, around.B, horizon)
    weighed = around.inputs @ cost.R
    pulls = around.deviations[:-1] @ cost.Q + weighed @ known.gains
    slopes = np.empty((horizon, batch, len(cost.Q)))
    v = around.deviations[-1] @ cost.Q_final
    for t in reversed(range(horizon)):
        slopes[t] = v
        v = pulls[t] + v @ known.closed[t]
    Q_u = weighed + slopes @ around.B
    k = -Q_u @ known.inverses
    slope = _inner(k, Q_u)
    return InputStep(known.gains, k, slope, -slope)


def _recursion(cost: QuadraticCost, around: Expansion, limits: Limits | None, ridge: Array | None) -> InputStep:
    """Expand the cost-to-go as ``v'dx + 1/2 dx'V dx`` from the horizon to the start.

    With z = (x, u) and F = (A, B), its expansion in z is ``q'dz + 1/2 dz'M dz`` with q = (Q_x, Q_u) and M of the blocks
    Q_xx, Q_ux and Q_uu.
    """
    horizon, batch, m = around.inputs.shape
    n = around.B.shape[-2]
    F = np.empty((n, n + m) if around.linear else (horizon, batch, n, n + m))
    F[..., :n], F[..., n:] = around.A, around.B
    F_T = np.ascontiguousarray(_T(F))  # products of contiguous matrices are twice as fast
    if around.linear:
        F, F_T = (np.broadcast_to(part, (horizon, *part.shape)) for part in (F, F_T))
    box = None if limits is None else (limits.low - around.inputs, limits.high - around.inputs)
    weights = np.block([[cost.Q, np.zeros((n, m))], [np.zeros((m, n)), cost.R]])
    pulls = np.concatenate([around.deviations[:-1] @ cost.Q, around.inputs @ cost.R], axis=-1)
    v, V = around.deviations[-1] @ cost.Q_final, cost.Q_final
    slopes, Q_uu_k = np.empty((horizon, batch, m)), np.empty((horizon, batch, m))
    k_all, K_all = np.empty((horizon, batch, m)), np.empty((horizon, batch, m, n))
    for t in reversed(range(horizon)):
        M = (F_T[t] @ V) @ F[t]
        M += weights
        q = pulls[t] + times(v, F[t])
        Q_u, Q_ux, Q_uu = q[:, n:], M[..., n:, :n], M[..., n:, n:]
        damped = Q_uu if ridge is None else Q_uu + ridge
        K, k = _solved(damped, Q_u, Q_ux, None if box is None else (box[0][t], box[1][t]))
        slopes[t], Q_uu_k[t], k_all[t], K_all[t] = Q_u, times(k, Q_uu), k, K
        v, V = q[:, :n] + times(k, Q_ux), M[..., :n, :n] + _T(Q_ux) @ K
        if ridge is not None:  # otherwise K'(Q_uu k + Q_u) and K'(Q_uu K + Q_ux) are zero
            v += times(Q_uu_k[t] + Q_u, K)
            V = V + _T(K) @ (Q_uu @ K + Q_ux)
        V = 0.5 * (V + _T(V))
    return InputStep(K_all, k_all, _inner(k_all, slopes), _inner(k_all, Q_uu_k))


def _solved(Q_uu: Array, Q_u: Array, Q_ux: Array, box: tuple[Array, Array] | None) -> tuple[Array, Array]:
    """Return the gains K ``(N, m, n)`` or ``(m, n)`` and k ``(N, m)`` within a box; inputs at a limit have no gain."""
    opposite = -_inverses(Q_uu)
    K, k = opposite @ Q_ux, times(Q_u, opposite)
    if box is None:
        return K, k
    low, high = box
    beyond = np.flatnonzero(((k <= low) | (k >= high)).any(axis=-1))
    if len(beyond):
        K, Q_uu, Q_ux = (part if part.ndim == 3 else np.repeat(part[None], len(k), axis=0) for part in (K, Q_uu, Q_ux))
        limits = low[beyond], high[beyond]
        K[beyond], k[beyond] = _within(limits, k[beyond], Q_uu[beyond], Q_u[beyond], Q_ux[beyond])
    return K, k


def _within(box: tuple[Array, Array], best: Array, Q_uu: Array, Q_u: Array, Q_ux: Array) -> tuple[Array, Array]:
    """Minimise ``Q_u'k + 1/2 k'Q_uu k`` over ``low <= k <= high``; return the gains K ``(N, m, n)`` and k ``(N, m)``.

    Projected Newton steps (Bertsekas 1982; Tassa, Mansard and Todorov 2014, Sec. III) from the minimum without limits,
    ``best``, projected onto the box. Inputs at a limit have no gain.
    """
    (low, high), m = box, Q_u.shape[-1]
    k = np.clip(best, low, high)
    largest = float(-(Q_u * best).sum(axis=-1).min())
    for _ in range(50):
        slope = Q_u + times(k, Q_uu)
        free = ~(((k <= low) & (slope > 0)) | ((k >= high) & (slope < 0)))
        inverse = _inverses(np.where(free[:, :, None] & free[:, None, :], Q_uu, np.eye(m)))
        direction = -times(np.where(free, slope, 0.0), inverse)
        decrease = float(-np.where(free, slope * direction, 0.0).sum(axis=-1).min())
        if decrease <= 1e-26 * largest:
            break
        k = _projected(k, direction, slope, Q_uu, box)
    return -inverse @ np.where(free[:, :, None], Q_ux, 0.0), k


def _projected(k: Array, direction: Array, slope: Array, Q_uu: Array, box: tuple[Array, Array]) -> Array:
    """Return for each row the longest of several steps, projected onto the box, with a tenth of its linear decrease."""
    whole = np.clip(k + direction, *box) - k
    if (_value(whole, slope, Q_uu) <= 0.1 * (whole * slope).sum(axis=-1)).all():
        return k + whole
    lengths = 0.5 ** np.arange(12)
    moves = np.clip(k + lengths[:, None, None] * direction, *box) - k
    enough = _value(moves, slope, Q_uu) <= 0.1 * (moves * slope).sum(axis=-1)
    chosen = moves[enough.argmax(axis=0), np.arange(len(k))]
    return k + np.where(enough.any(axis=0)[:, None], chosen, 0.0)


def _value(moves: Array, slope: Array, Q_uu: Array) -> Array:
    """Return ``slope'k + 1/2 k'Q_uu k`` for moves k ``(..., N, m)``."""
    return np.asarray((moves * (slope + 0.5 * (moves[..., None, :] @ Q_uu)[..., 0, :])).sum(axis=-1))


def _inner(first: Array, second: Array) -> Array:
    """Return the sums over time and inputs of products, ``(N,)``."""
    return np.asarray(np.einsum("tni,tni->n", first, second))


def _inverses(matrices: Array) -> Array:
    """Return the inverses of positive definite matrices ``(..., m, m)``; in closed form for one and two inputs."""
    m = matrices.shape[-1]
    if m == 1:
        return 1.0 / matrices
    if m > 2 or matrices.size < 16:  # LAPACK inverts few matrices of two rows faster than the closed form
        return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    determinants = matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0]
    inverses = np.swapaxes(matrices[..., ::-1, ::-1], -1, -2) * np.array([[1.0, -1.0], [-1.0, 1.0]])
    inverses *= (1.0 / determinants)[..., None, None]
    return np.asarray(inverses)


def times(rows: Array, matrix: np.ndarray[Any, np.dtype[np.floating[Any]]]) -> Array:
    """Return ``row' M`` for rows ``(N, a)`` and one matrix ``(a, b)`` or N of them."""
    return np.asarray(rows @ matrix if matrix.ndim == 2 else (rows[:, None, :] @ matrix)[:, 0, :])


def _T(matrix: Array) -> Array:
    return np.swapaxes(matrix, -1, -2)
