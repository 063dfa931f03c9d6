"""The backward pass of iLQR: minimisers of the quadratic expansion of the cost-to-go, for a batch of tasks.

Input limits after control-limited differential dynamic programming (Tassa, Mansard and Todorov 2014).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import call
from ctxval.controllers.cost import QuadraticCost
from ctxval.controllers.riccati import linear_gains
from ctxval.core.controller import Limits

_STEP_LENGTHS = 0.5 ** np.arange(12)
"""Step lengths of projected Newton steps, the longest first."""
_NEWTON_STEPS = 50
"""Largest number of projected Newton steps for inputs with limits."""
_NEWTON_DECREASE = 0.1
"""Share of its linear decrease that a projected Newton step must reach."""
_NEWTON_SETTLED = 1e-26
"""Share of the largest decrease so far at which projected Newton steps have converged."""


@dataclass(frozen=True, eq=False)
class Change:
    """The expected change of the cost, ``length * slope + length^2 / 2 * curvature``; both of shape ``(N,)``."""

    slope: Array
    curvature: Array

    def at(self, length: float | Array) -> Array:
        """Return the expected changes of steps of these lengths, shape ``(N,)``."""
        return length * self.slope + 0.5 * length**2 * self.curvature

    def __repr__(self) -> str:
        return call(self, tasks=len(self.slope))


@dataclass(frozen=True, eq=False)
class Policy:
    """A step of the inputs with its feedback, and what it is expected to change.

    Attributes:
        K: the gains, shape ``(H, N, m, n)``, or ``(H, m, n)`` if all tasks share them.
        k: the feedforward, shape ``(H, N, m)``.
        change: the expected change of the cost.
    """

    K: Array
    k: Array
    change: Change

    def __repr__(self) -> str:
        return call(self, gains=self.K, feedforward=self.k)


@dataclass(frozen=True, eq=False)
class Expansion:
    """What the cost is expanded around, time first: N tasks with n states and m inputs.

    Attributes:
        deviations: the states minus their references, shape ``(H + 1, N, n)``.
        inputs: shape ``(H, N, m)``.
        A: derivatives by the state, ``(H, N, n, n)``, or ``(n, n)`` if they are constant.
        B: derivatives by the input, ``(H, N, n, m)``, or ``(n, m)`` if they are constant.
    """

    deviations: Array
    inputs: Array
    A: Array
    B: Array

    @property
    def linear(self) -> bool:
        """Whether the model is linear."""
        return self.A.ndim == 2 and self.B.ndim == 2

    def __repr__(self) -> str:
        return call(self, deviations=self.deviations, inputs=self.inputs)


def minimise(cost: QuadraticCost, around: Expansion, limits: Limits | None, damping: Array) -> Policy:
    """Return the step that minimises the expansion of the cost, over inputs within the limits.

    Args:
        cost: the weights.
        around: the states, inputs and derivatives.
        limits: limits of the inputs, if any.
        damping: added to the curvature of the inputs of each task, shape ``(N,)``.
    """
    if limits is None and not damping.any():
        return _linear(cost, around) if around.linear else _recursion(cost, around, _Unlimited(0.0))
    ridge = damping[:, None, None] * np.eye(len(cost.R))
    if limits is None:
        return _recursion(cost, around, _Unlimited(ridge))
    return _recursion(cost, around, _Limited(ridge, limits.low - around.inputs, limits.high - around.inputs))


def _linear(cost: QuadraticCost, around: Expansion) -> Policy:
    """Return the step for a linear model: its gains are known, so only the slope of the cost-to-go is computed."""
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
    slope = np.einsum("tni,tni->n", k, Q_u)
    return Policy(known.gains, k, Change(slope, -slope))


def _recursion(cost: QuadraticCost, around: Expansion, stage: _Unlimited | _Limited) -> Policy:
    """Expand the cost-to-go as ``v'dx + 1/2 dx'V dx`` from the horizon to the start.

    With z = (x, u) and F = (A, B), its expansion in z is ``q'dz + 1/2 dz'M dz`` with q = (Q_x, Q_u) and M of the blocks
    Q_xx, Q_ux and Q_uu.
    """
    horizon, batch, m = around.inputs.shape
    F, F_T = _joined(around, (horizon, batch))
    n = F.shape[-2]
    weights = np.block([[cost.Q, np.zeros((n, m))], [np.zeros((m, n)), cost.R]])
    own = np.concatenate([around.deviations[:-1] @ cost.Q, around.inputs @ cost.R], axis=-1)
    v, V = around.deviations[-1] @ cost.Q_final, cost.Q_final
    slope, curvature = np.zeros(batch), np.zeros(batch)
    k_all, K_all = np.empty((horizon, batch, m)), np.empty((horizon, batch, m, n))
    for t in reversed(range(horizon)):
        M = (F_T[t] @ V) @ F[t]
        M += weights
        q = own[t] + times(v, F[t])
        Q_u, Q_ux, Q_uu = q[:, n:], M[..., n:, :n], M[..., n:, n:]
        K, k = stage.solve(t, Q_uu, Q_u, Q_ux)
        Q_uu_k = times(k, Q_uu)
        slope += (k * Q_u).sum(axis=-1)
        curvature += (k * Q_uu_k).sum(axis=-1)
        K_T = _T(K)
        if stage.exact:  # Q_uu K = -Q_ux and Q_uu k = -Q_u
            v, V = q[:, :n] + times(Q_u, K), M[..., :n, :n] + K_T @ Q_ux
        else:
            v = q[:, :n] + times(Q_uu_k + Q_u, K) + times(k, Q_ux)
            V = M[..., :n, :n] + K_T @ (Q_uu @ K + Q_ux) + _T(Q_ux) @ K
        V = 0.5 * (V + _T(V))
        k_all[t], K_all[t] = k, K
    return Policy(K_all, k_all, Change(slope, curvature))


def _joined(around: Expansion, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Return F = (A, B), shape ``(H, N, n, n + m)`` or ``(H, n, n + m)`` if it is constant, and its transpose."""
    A, B = around.A, around.B
    n, m = B.shape[-2:]
    F = np.empty((n, n + m) if around.linear else (*shape, n, n + m))
    F[..., :n], F[..., n:] = A, B
    F_T = np.ascontiguousarray(_T(F))  # products of contiguous matrices are twice as fast
    if around.linear:
        return np.broadcast_to(F, (shape[0], *F.shape)), np.broadcast_to(F_T, (shape[0], *F_T.shape))
    return F, F_T


@dataclass(frozen=True, eq=False)
class _Unlimited:
    """Minimisation over inputs without limits.

    Attributes:
        ridge: the damping, ``(N, m, m)``, or zero.
    """

    ridge: Array | float

    @property
    def exact(self) -> bool:
        """Whether the step minimises the expansion itself, without damping and limits."""
        return isinstance(self.ridge, float)

    def solve(self, t: int, Q_uu: Array, Q_u: Array, Q_ux: Array) -> tuple[Array, Array]:
        """Return the gains K ``(N, m, n)``, or ``(m, n)``, and k ``(N, m)``."""
        opposite = -_inverses(Q_uu if self.exact else Q_uu + self.ridge)
        return opposite @ Q_ux, times(Q_u, opposite)


@dataclass(frozen=True, eq=False)
class _Limited:
    """Minimisation over inputs within limits.

    Attributes:
        ridge: the damping, ``(N, m, m)``.
        low, high: the limits of the step k, shape ``(H, N, m)``.
    """

    ridge: Array
    low: Array
    high: Array

    exact = False

    def solve(self, t: int, Q_uu: Array, Q_u: Array, Q_ux: Array) -> tuple[Array, Array]:
        """Return the gains K ``(N, m, n)`` and k ``(N, m)``; inputs at a limit have no gain."""
        N, m = Q_u.shape
        Q_uu = np.broadcast_to(Q_uu + self.ridge, (N, m, m))
        opposite = -_inverses(Q_uu)
        k, K = times(Q_u, opposite), opposite @ Q_ux
        low, high = self.low[t], self.high[t]
        beyond = np.flatnonzero(((k <= low) | (k >= high)).any(axis=-1))
        if len(beyond):
            Q_ux = np.broadcast_to(Q_ux, (N, *Q_ux.shape[-2:]))[beyond]
            K = np.array(np.broadcast_to(K, (N, *K.shape[-2:])))
            K[beyond], k[beyond] = _within((low[beyond], high[beyond]), Q_uu[beyond], Q_u[beyond], Q_ux)
        return K, k


def _within(box: tuple[Array, Array], Q_uu: Array, Q_u: Array, Q_ux: Array) -> tuple[Array, Array]:
    """Minimise ``Q_u'k + 1/2 k'Q_uu k`` over ``low <= k <= high``; return the gains K ``(N, m, n)`` and k ``(N, m)``.

    Projected Newton steps (Bertsekas 1982; Tassa, Mansard and Todorov 2014, Sec. III). Inputs at a limit have no gain.
    """
    (low, high), m = box, Q_u.shape[-1]
    k = np.zeros_like(Q_u)  # within the box, as the inputs are
    largest = 0.0
    for _ in range(_NEWTON_STEPS):
        slope = Q_u + times(k, Q_uu)
        free = ~(((k <= low) & (slope > 0)) | ((k >= high) & (slope < 0)))
        inverse = _inverses(np.where(free[:, :, None] & free[:, None, :], Q_uu, np.eye(m)))
        direction = -times(np.where(free, slope, 0.0), inverse)
        decrease = float(-np.where(free, slope * direction, 0.0).sum(axis=-1).min(initial=0.0))
        largest = max(largest, decrease)
        if decrease <= _NEWTON_SETTLED * largest:
            break
        k = _projected(k, direction, slope, Q_uu, box)
    return -inverse @ np.where(free[:, :, None], Q_ux, 0.0), k


def _projected(k: Array, direction: Array, slope: Array, Q_uu: Array, box: tuple[Array, Array]) -> Array:
    """Return for each row the longest of several steps, projected onto the box, that lowers its value enough."""
    moves = np.clip(k + _STEP_LENGTHS[:, None, None] * direction, *box) - k
    linear = (moves * slope).sum(axis=-1)
    change = linear + 0.5 * (moves * (moves[..., None, :] @ Q_uu)[..., 0, :]).sum(axis=-1)
    enough = change <= _NEWTON_DECREASE * linear
    chosen = moves[enough.argmax(axis=0), np.arange(len(k))]
    return k + np.where(enough.any(axis=0)[:, None], chosen, 0.0)


def _inverses(matrices: Array) -> Array:
    """Return the inverses of positive definite matrices ``(..., m, m)``; in closed form for one and two inputs."""
    m = matrices.shape[-1]
    if m == 1:
        return 1.0 / matrices
    if m > 2:
        return np.linalg.inv(matrices)
    a, b, c, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 0], matrices[..., 1, 1]
    share = 1.0 / (a * d - b * c)
    found = np.empty(matrices.shape)
    found[..., 0, 0], found[..., 0, 1] = d * share, -b * share
    found[..., 1, 0], found[..., 1, 1] = -c * share, a * share
    return found


def times(rows: Array, matrix: np.ndarray[Any, np.dtype[np.floating[Any]]]) -> Array:
    """Return ``row' M`` for rows ``(N, a)`` and one matrix ``(a, b)`` or N of them."""
    return np.asarray(rows @ matrix if matrix.ndim == 2 else (rows[:, None, :] @ matrix)[:, 0, :])


def _T(matrix: Array) -> Array:
    return np.swapaxes(matrix, -1, -2)
