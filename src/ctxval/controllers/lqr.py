"""Quadratic costs, and linear-quadratic regulators: over a horizon by the Riccati recursion, and stationary ones."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_weight
from ctxval._util.refusals import reworded
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import AffineFeedback, Limits, LimitsLike
from ctxval.core.model import Model, linearize
from ctxval.core.task import Task
from ctxval.errors import DesignError, InputError, ShapeError


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
        running, final = deviations[:-1], deviations[-1]
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


@part()
class LQR(QuadraticSynthesizer):
    """The linear-quadratic regulator that tracks the task's reference over its horizon.

    A nonlinear model is linearised once, at the task's initial state and zero input.

    Limits only clip the inputs, on the model and on the system. The gains are those of the problem without limits, and
    are optimal as long as no limit is reached. iLQR and MPC take limits into account in the design.

    Args:
        Q, R, Q_final: weights of the state, the input and the last state (Q by default), as diagonals or as matrices.
        limits: limits of the inputs, rows ``[low, high]`` for each, or one number h for ``[-h, h]`` of all.
    """

    def __init__(
        self, Q: ArrayLike, R: ArrayLike, Q_final: ArrayLike | None = None, *, limits: LimitsLike | None = None
    ) -> None:
        super().__init__(QuadraticCost(Q, R, Q_final), limits)

    def design(self, task: Task, model: Model) -> AffineFeedback:
        self.cost.require_task(task)
        x0 = task.initial_state
        u0 = np.zeros((*task.batch_shape, len(self.cost.R)))
        A, B = linearize(model, x0, u0)
        _require_inputs(self.cost, B)
        offset = model.step(x0, u0) - (A @ x0[..., None])[..., 0]
        if A.ndim == 2 and B.ndim == 2:
            known = linear_gains(self.cost, A, B, task.horizon)
            gains, feedforward = known.gains, _feedforward(self.cost, known, B, offset, task.reference)
        else:
            gains, feedforward = _riccati(self.cost, A, B, offset, task.reference)
        return AffineFeedback(gains, feedforward, np.zeros_like(task.reference[..., :-1, :]), self.limits)


@part()
class StationaryLQR(QuadraticSynthesizer):
    """The infinite-horizon linear-quadratic regulator, with one gain from the algebraic Riccati equation.

    The feedback ``u = u_g + K (x - r_t)`` follows the task's reference. The input u_g holds the task's goal as well as
    possible in the sense of least squares, and the model is linearised there. If no input holds the goal, an offset
    remains.

    Limits only clip the inputs, as for :class:`LQR`.

    Args:
        Q, R: weights of the state and the input, as diagonals or as matrices.
        limits: limits of the inputs, rows ``[low, high]`` for each, or one number h for ``[-h, h]`` of all.
    """

    def __init__(self, Q: ArrayLike, R: ArrayLike, *, limits: LimitsLike | None = None) -> None:
        super().__init__(QuadraticCost(Q, R), limits)

    def design(self, task: Task, model: Model) -> AffineFeedback:
        self.cost.require_task(task)
        holding = np.zeros((*task.batch_shape, len(self.cost.R)))
        _, B = linearize(model, task.goal, holding)
        _require_inputs(self.cost, B)
        # One Gauss-Newton step, which is exact for models that are affine in the input.
        missing = task.goal - model.step(task.goal, holding)
        holding = holding + (np.linalg.pinv(B) @ missing[..., None])[..., 0]
        K = _stationary_gain(self.cost, *linearize(model, task.goal, holding))
        gains = np.repeat(K[..., None, :, :], task.horizon, axis=-3)
        inputs = np.repeat(holding[..., None, :], task.horizon, axis=-2)
        return AffineFeedback(gains, inputs, task.reference[..., :-1, :], self.limits)


def _require_inputs(cost: QuadraticCost, B: Array) -> None:
    if not B.shape[-1]:
        advice = "use a synthesizer of your own, whose controllers return inputs of shape (..., 0)"
        raise InputError(f"LQR designs inputs, and the model has 0 inputs; {advice}.")
    if B.shape[-1] != len(cost.R):
        raise InputError(f"R must weigh the model's {B.shape[-1]} inputs, got a weight of {len(cost.R)} inputs.")


def _stationary_gain(cost: QuadraticCost, A: Array, B: Array) -> Array:
    """Return K ``(..., m, n)`` of ``u = K x``."""
    if A.ndim > 2 or B.ndim > 2:
        batch = np.broadcast_shapes(A.shape[:-2], B.shape[:-2])
        many = (np.broadcast_to(part, (*batch, *part.shape[-2:])).reshape(-1, *part.shape[-2:]) for part in (A, B))
        gains = [_stationary_gain(cost, A_i, B_i) for A_i, B_i in zip(*many, strict=True)]
        return np.stack(gains).reshape(*batch, *gains[0].shape)
    from scipy.linalg import solve_discrete_are

    failure = "no stationary feedback stabilises the model at the goal"
    with reworded(f"{failure}", np.linalg.LinAlgError, ValueError, to=DesignError):
        P = solve_discrete_are(A, B, cost.Q, cost.R)
    K = -np.linalg.solve(cost.R + B.T @ P @ B, B.T @ P @ A)
    radius = float(np.abs(np.linalg.eigvals(A + B @ K)).max())
    if not radius < 1:
        largest = f"the largest eigenvalue of its closed loop has modulus {radius:.6g}, which must be below 1"
        raise DesignError(f"{failure}: {largest}.")
    return np.asarray(K)


def _riccati(cost: QuadraticCost, A: Array, B: Array, offset: Array, reference: Array) -> tuple[Array, Array]:
    """Solve for K_t and k_t backwards, with the cost-to-go ``1/2 x'P x + p'x``."""
    A_t, B_t = np.swapaxes(A, -1, -2), np.swapaxes(B, -1, -2)
    horizon, P = reference.shape[-2] - 1, cost.Q_final
    p = -reference[..., -1, :] @ cost.Q_final
    gains, feedforward = [], []
    for t in reversed(range(horizon)):
        curvature = cost.R + B_t @ P @ B
        K = -np.linalg.solve(curvature, B_t @ P @ A)
        slope = p + (P @ offset[..., None])[..., 0]
        k = -np.linalg.solve(curvature, B_t @ slope[..., None])[..., 0]
        closed = np.swapaxes(A + B @ K, -1, -2)
        p = -reference[..., t, :] @ cost.Q + (closed @ slope[..., None])[..., 0]
        P = cost.Q + A_t @ P @ (A + B @ K)
        P = 0.5 * (P + np.swapaxes(P, -1, -2))
        gains.append(K)
        feedforward.append(k)
    return np.stack(gains[::-1], axis=-3), np.stack(feedforward[::-1], axis=-2)


def _feedforward(cost: QuadraticCost, known: LinearGains, B: Array, offset: Array, reference: Array) -> Array:
    """Return k_t ``(..., H, m)`` for gains that are known, with the slope p of the cost-to-go as in ``_riccati``."""
    horizon, n = len(known.gains), len(B)
    pulls = -np.moveaxis(reference, -2, 0).reshape(horizon + 1, -1, n)
    pulls[:-1], pulls[-1] = pulls[:-1] @ cost.Q, pulls[-1] @ cost.Q_final
    offsets = offset.reshape(-1, n) @ known.curvatures
    slopes = np.empty_like(pulls[:-1])
    p = pulls[-1]
    for t in reversed(range(horizon)):
        slopes[t] = p + offsets[t]
        p = pulls[t] + slopes[t] @ known.closed[t]
    k = -slopes @ (B @ known.inverses)
    return np.moveaxis(k, 0, 1).reshape(*reference.shape[:-2], horizon, -1)
