"""Finite-horizon linear-quadratic tracking by the Riccati recursion."""

from __future__ import annotations

import numpy as np

from ctxval.arrays import Array, ArrayLike
from ctxval.controller import AffineFeedback
from ctxval.controllers.cost import QuadraticCost
from ctxval.model import Model, linearize
from ctxval.task import Task


class LQR:
    """The linear-quadratic regulator that tracks the task's reference over its horizon.

    A nonlinear model is linearised once, at the task's initial state and zero input.

    Args:
        Q: state weight, its diagonal ``(n,)`` or matrix ``(n, n)``.
        R: input weight, its diagonal ``(m,)`` or matrix ``(m, m)``.
        Q_final: weight of the last state; Q by default.

    Raises:
        InputError: the weights are not positive semidefinite, or R not positive definite.
    """

    batched = True

    def __init__(self, Q: ArrayLike, R: ArrayLike, Q_final: ArrayLike | None = None) -> None:
        self.cost = QuadraticCost(Q, R, Q_final)

    def design(self, task: Task, model: Model) -> AffineFeedback:
        """Return the feedback ``u = K_t x + k_t`` that minimises the cost on the (linearised) model."""
        self.cost.require_task(task)
        x0 = task.initial_state
        u0 = np.zeros((*task.batch_shape, len(self.cost.R)))
        A, B = linearize(model, x0, u0)
        offset = model.step(x0, u0) - (A @ x0[..., None])[..., 0]
        gains, feedforward = _riccati(self.cost, A, B, offset, task.reference)
        return AffineFeedback(gains, feedforward, np.zeros_like(task.reference[..., :-1, :]))


def _riccati(cost: QuadraticCost, A: Array, B: Array, offset: Array, reference: Array) -> tuple[Array, Array]:
    """Solve for K_t and k_t backwards, with the cost-to-go ``1/2 x'P x + p'x``."""
    A_t, B_t = np.swapaxes(A, -1, -2), np.swapaxes(B, -1, -2)
    horizon = reference.shape[-2] - 1
    P = cost.Q_final
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
