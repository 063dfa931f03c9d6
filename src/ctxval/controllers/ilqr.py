"""Iterative LQR (Li and Todorov 2004; regularisation and line search after Tassa, Erez and Todorov 2012).

Input limits after control-limited differential dynamic programming (Tassa, Mansard and Todorov 2014).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Mask, Rows
from ctxval._util.registry import part
from ctxval._util.representation import call, record
from ctxval.controllers.cost import QuadraticCost
from ctxval.core.controller import AffineFeedback, Limits, LimitsLike
from ctxval.core.model import Model, linearize
from ctxval.core.task import Task
from ctxval.errors import DesignError, InputError

_STEP_LENGTHS = 0.5 ** np.arange(12)
"""Step lengths of the line search, the longest first."""
_SUFFICIENT_DECREASE = 1e-4
"""Share of the expected decrease of the cost that a step must reach."""
_DAMPING_MIN = 1e-6
"""Smallest damping that is not zero."""
_DAMPING_MAX = 1e10
"""Damping above which the iteration of a task stops, because no step improves its cost."""
_NEWTON_STEPS = 50
"""Largest number of projected Newton steps for inputs with limits."""
_NEWTON_DECREASE = 0.1
"""Share of its linear decrease that a projected Newton step must reach."""
_NEWTON_SETTLED = 1e-26
"""Share of the largest decrease so far at which projected Newton steps have converged."""
_ROUNDING = 1e12
"""Largest ratio of the old cost to the new one in one step; beyond it rounding errors call for another step.

Below it the relative error of the states is below 1e-10.
"""


@dataclass(frozen=True, eq=False)
class ILQRSolution:
    """The solution of iLQR for one task or a batch.

    Attributes:
        controller: the feedback around the optimised trajectory.
        cost: the cost of the optimised trajectory, shape ``(...)``.
        iterations: the number of accepted steps, integers of shape ``(...)``.
        converged: whether the iteration converged, shape ``(...)``; it did not if the limit of iterations was reached
            or no step improved the cost.
    """

    controller: AffineFeedback
    cost: Array
    iterations: Array
    converged: Array

    def __repr__(self) -> str:
        return record(self)


@part()
class ILQR:
    """Finite-horizon iterative LQR on any model, for a whole batch of tasks at once.

    It minimises a quadratic cost on the deviation from the task's reference. On a linear model without limits it
    converges in one iteration, to the Riccati solution.

    It takes input limits into account: every backward step minimises over the inputs within the limits, inputs at a
    limit get no feedback, and roll-outs are clipped. The controller clips its inputs on the model and on the system.

    Args:
        Q: weight of the state, as a diagonal ``(n,)`` or a matrix ``(n, n)``.
        R: weight of the input, as a diagonal ``(m,)`` or a matrix ``(m, m)``.
        Q_final: weight of the last state; Q by default.
        iterations: largest number of steps for one task.
        tolerance: the iteration stops if the next step would lower the cost by less than this fraction of it.
        limits: limits of the inputs: one number h for -h to h, ``Limits(low=, high=)``, a mapping of low and high, or
            rows ``[low, high]``, one for each input.

    Raises:
        InputError: if a weight is not positive semidefinite, R is not positive definite, iterations or tolerance are
            not positive, or the limits are ambiguous or not low < high.
    """

    batched = True

    def __init__(
        self,
        Q: ArrayLike,
        R: ArrayLike,
        Q_final: ArrayLike | None = None,
        *,
        iterations: int = 100,
        tolerance: float = 1e-8,
        limits: LimitsLike | None = None,
    ) -> None:
        self.cost = QuadraticCost(Q, R, Q_final)
        self.iterations = iterations
        self.tolerance = tolerance
        if iterations < 1 or not tolerance > 0:
            raise InputError(f"iterations and tolerance must be positive, got {iterations!r} and {tolerance!r}.")
        self.limits = None if limits is None else Limits.of(limits, len(self.cost.R))

    def describe(self) -> dict[str, Any]:
        """Return what identifies this synthesizer in a store."""
        fields = {"cost": self.cost, "iterations": self.iterations, "tolerance": self.tolerance}
        return {**fields, **({} if self.limits is None else {"limits": self.limits})}

    def design(self, task: Task, model: Model) -> AffineFeedback:
        """Return the feedback around the optimised trajectory of the model.

        Raises:
            DesignError: if the model diverges under zero input.
        """
        return self.solve(task, model).controller

    def solve(self, task: Task, model: Model) -> ILQRSolution:
        """Return the controller, and for each task the cost, the number of iterations and whether they converged.

        Raises:
            DesignError: if the model diverges under zero input.
        """
        self.cost.require_task(task)
        with np.errstate(all="ignore"):
            descent = _Descent(self, task, model)
            while len(rows := descent.active_rows()):
                descent.advance(rows)
        return descent.solution(task.batch_shape)

    def __repr__(self) -> str:
        return call(
            self, **self.cost.weights(), iterations=self.iterations, tolerance=self.tolerance, limits=self.limits
        )


class _Descent:
    """The iterates of all tasks, time first: states X ``(H+1, N, n)``, inputs U ``(H, N, m)``."""

    def __init__(self, settings: ILQR, task: Task, model: Model) -> None:
        n, m = task.initial_state.shape[-1], len(settings.cost.R)
        self.settings, self.cost, self.model, self.limits = settings, settings.cost, model, settings.limits
        self.reference = np.moveaxis(task.reference.reshape(-1, task.horizon + 1, n), 1, 0)
        batch = self.reference.shape[1]
        self.U = self._clipped(np.zeros((task.horizon, batch, m)))
        self.X = np.empty((task.horizon + 1, batch, n))
        self.X[0] = task.initial_state.reshape(-1, n)
        self.K = np.zeros((task.horizon, batch, m, n))
        self.X, self.U, self.J = self._forward(np.arange(batch), _Policy(self.K, self.U), np.zeros(batch))
        if not np.isfinite(self.J).all():
            raise DesignError("iLQR cannot start: the model diverges under zero input within the horizon.")
        self.damping = np.zeros(batch)
        self.refused = np.zeros(batch, dtype=bool)  # the line search has failed at the present iterate
        self.iterations = np.zeros(batch, dtype=int)
        self.converged = np.zeros(batch, dtype=bool)

    def active_rows(self) -> Rows:
        """Return the tasks whose iteration continues."""
        stuck = self.damping > _DAMPING_MAX
        return np.flatnonzero(~self.converged & ~stuck & (self.iterations < self.settings.iterations))

    def advance(self, rows: Rows) -> None:
        """Take one step for these tasks, or mark them as converged."""
        A, B = linearize(self.model, self.X[:-1, rows], self.U[:, rows])
        policy, change = self._backward(rows, A, B)
        self.K[:, rows] = policy.K if policy.K.ndim == 4 else policy.K[:, None]
        gain = -change.at(np.ones(len(rows)))
        arrived = gain <= self.settings.tolerance * (np.abs(self.J[rows]) + self.settings.tolerance)
        # A damped step is always small, so only an undamped step may mark a task as converged.
        self.converged[rows] = arrived & (self.damping[rows] == 0)
        # If the line search has already refused the undamped step, no step improves the cost.
        self.damping[rows[arrived]] = np.where(self.refused[rows[arrived]], np.inf, 0.0)
        before = self.J[rows]
        moved = self._line_search(rows, policy, change, ~arrived)
        if A.ndim == 2 and B.ndim == 2 and self.limits is None:
            # The model is linear, so the step was the exact minimiser, and its gains hold everywhere. If the cost was
            # far larger before, as on an unstable model, rounding errors call for another step.
            self.converged[rows[moved]] = (before <= _ROUNDING * self.J[rows])[moved]

    def _backward(self, rows: Rows, A: Array, B: Array) -> tuple[_Policy, _Change]:
        """Minimise the quadratic expansion of the cost-to-go ``v'dx + 1/2 dx'V dx``, from the horizon to the start."""
        deviations = self.X[:, rows] - self.reference[:, rows]
        inputs = self.U[:, rows]
        damping = self.damping[rows]
        ridge = damping[:, None, None] * np.eye(inputs.shape[-1]) if damping.any() else 0.0
        v, V = deviations[-1] @ self.cost.Q_final, self.cost.Q_final
        slope, curvature = np.zeros(len(rows)), np.zeros(len(rows))
        gains, feedforward = [], []
        for t in reversed(range(len(inputs))):
            A_t, B_t = A if A.ndim == 2 else A[t], B if B.ndim == 2 else B[t]
            VA, VB = V @ A_t, V @ B_t
            Q_x, Q_u = deviations[t] @ self.cost.Q + _times(v, A_t), inputs[t] @ self.cost.R + _times(v, B_t)
            Q_ux, Q_uu = _T(B_t) @ VA, self.cost.R + _T(B_t) @ VB
            if self.limits is None:
                inverse = np.linalg.inv(Q_uu + ridge)
                K, k = -inverse @ Q_ux, -_times(Q_u, inverse)
            else:
                box = self.limits.low - inputs[t], self.limits.high - inputs[t]
                K, k = _within(box, Q_uu + ridge, Q_u, Q_ux)
            Q_uu_k = _times(k, Q_uu)
            slope += (k * Q_u).sum(axis=-1)
            curvature += (k * Q_uu_k).sum(axis=-1)
            v = Q_x + _times(Q_uu_k + Q_u, K) + _times(k, Q_ux)
            V = self.cost.Q + _T(A_t) @ VA + _T(K) @ (Q_uu @ K + Q_ux) + _T(Q_ux) @ K
            V = 0.5 * (V + _T(V))
            gains.append(K)
            feedforward.append(k)
        return _Policy(np.stack(gains[::-1]), np.stack(feedforward[::-1])), _Change(slope, curvature)

    def _line_search(self, rows: Rows, policy: _Policy, change: _Change, wanted: Mask) -> Rows:
        """Accept for each wanted task the longest step that lowers its cost; return the tasks with such a step."""
        waiting = np.flatnonzero(wanted)
        for length in _STEP_LENGTHS:
            if not len(waiting):
                break
            lengths = np.full(len(waiting), length)
            X, U, J = self._forward(rows[waiting], policy.of(waiting), lengths)
            expected = change.at(length)[waiting]
            accepted = self.J[rows[waiting]] - J >= -_SUFFICIENT_DECREASE * expected
            self._accept(rows[waiting[accepted]], X[:, accepted], U[:, accepted], J[accepted])
            waiting = waiting[~accepted]
        failed = rows[waiting]
        self.damping[failed] = np.maximum(_DAMPING_MIN, 10 * self.damping[failed])
        self.refused[failed] = True
        moved = wanted.copy()
        moved[waiting] = False
        return np.flatnonzero(moved)

    def _accept(self, rows: Rows, X: Array, U: Array, J: Array) -> None:
        self.X[:, rows], self.U[:, rows], self.J[rows] = X, U, J
        self.iterations[rows] += 1
        self.refused[rows] = False
        self.damping[rows] = np.where(self.damping[rows] > _DAMPING_MIN, self.damping[rows] / 10, 0.0)

    def _forward(self, rows: Rows, policy: _Policy, lengths: Array) -> tuple[Array, Array, Array]:
        """Run the model under ``u = u_old + length * k + K (x - x_old)``; return states, inputs and costs."""
        X_old, U_old = self.X[:, rows], self.U[:, rows]
        X, U = np.empty_like(X_old), np.empty_like(U_old)
        X[0] = X_old[0]
        for t in range(len(U)):
            U[t] = U_old[t] + lengths[:, None] * policy.k[t]
            if lengths.any():
                U[t] += _times(X[t] - X_old[t], _T(policy.K[t]))
            U[t] = self._clipped(U[t])
            X[t + 1] = self.model.step(X[t], U[t])
        J = self.cost.value(X - self.reference[:, rows], U)
        return X, U, np.where(np.isfinite(J), J, np.inf)

    def _clipped(self, inputs: Array) -> Array:
        return inputs if self.limits is None else self.limits.clip(inputs)

    def solution(self, batch_shape: tuple[int, ...]) -> ILQRSolution:
        """Return the iterates as a solution, batch first."""

        def batch_first(array: Array) -> Array:
            return np.moveaxis(array, 0, 1).reshape(*batch_shape, len(array), *array.shape[2:])

        parts = batch_first(self.K), batch_first(self.U), batch_first(self.X[:-1])
        controller = AffineFeedback(*parts, self.limits)
        return ILQRSolution(
            controller,
            self.J.reshape(batch_shape),
            self.iterations.reshape(batch_shape),
            self.converged.reshape(batch_shape),
        )


@dataclass(frozen=True, eq=False)
class _Policy:
    """Gains K ``(H, N, m, n)``, or ``(H, m, n)`` if all tasks share them, and feedforward k ``(H, N, m)``."""

    K: Array
    k: Array

    def of(self, rows: Rows) -> _Policy:
        return _Policy(self.K if self.K.ndim == 3 else self.K[:, rows], self.k[:, rows])


@dataclass(frozen=True, eq=False)
class _Change:
    """The expected change of the cost, ``length * slope + length^2 / 2 * curvature``."""

    slope: Array
    curvature: Array

    def at(self, length: float | Array) -> Array:
        return length * self.slope + 0.5 * length**2 * self.curvature


def _within(box: tuple[Array, Array], Q_uu: Array, Q_u: Array, Q_ux: Array) -> tuple[Array, Array]:
    """Minimise ``Q_u'k + 1/2 k'Q_uu k`` over ``low <= k <= high``; return the gains K ``(N, m, n)`` and k ``(N, m)``.

    Projected Newton steps (Bertsekas 1982; Tassa, Mansard and Todorov 2014, Sec. III). Inputs at a limit have no gain.
    """
    (low, high), (N, m) = box, Q_u.shape
    Q_uu, Q_ux = np.broadcast_to(Q_uu, (N, m, m)), np.broadcast_to(Q_ux, (N, *Q_ux.shape[-2:]))
    k = np.zeros((N, m))  # within the box, as the inputs are
    largest = 0.0
    for _ in range(_NEWTON_STEPS):
        slope = Q_u + _times(k, Q_uu)
        free = ~(((k <= low) & (slope > 0)) | ((k >= high) & (slope < 0)))
        inverse = np.linalg.inv(np.where(free[:, :, None] & free[:, None, :], Q_uu, np.eye(m)))
        direction = -_times(np.where(free, slope, 0.0), inverse)
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


def _times(rows: Array, matrix: np.ndarray[Any, np.dtype[np.floating[Any]]]) -> Array:
    """Return ``row' M`` for rows ``(N, a)`` and one matrix ``(a, b)`` or N of them."""
    return np.asarray(rows @ matrix if matrix.ndim == 2 else (rows[:, None, :] @ matrix)[:, 0, :])


def _T(matrix: Array) -> Array:
    return np.swapaxes(matrix, -1, -2)
