"""Iterative LQR (Li and Todorov 2004; regularisation and line search after Tassa, Erez and Todorov 2012)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Mask, Rows
from ctxval._util.checked import PositiveFloat, PositiveInt
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.controllers.lqr import QuadraticCost, QuadraticSynthesizer, linear_gains
from ctxval.core.controller import AffineFeedback, Limits, LimitsLike, fed_back
from ctxval.core.model import Model, linearize, run_of
from ctxval.core.task import Task
from ctxval.errors import DesignError, ModelError

_STEP_LENGTHS: Array = np.asarray(0.5 ** np.arange(12), dtype=np.float64)
_LEAST_DAMPING = 1e-6  # that is not zero


@dataclass(frozen=True, eq=False)
class ILQRSolution(ShortRepr):
    """The solution of iLQR for one task or a batch: the feedback around the optimised trajectory, and its cost.

    The iterations are the accepted steps. A design has not converged if the limit of iterations was reached or no step
    improved the cost; the gains are those of an undamped step at the solution in any case.
    """

    controller: AffineFeedback
    cost: Array
    iterations: Array
    converged: Array


@part()
class ILQR(QuadraticSynthesizer):
    """Finite-horizon iterative LQR on any model, for a whole batch of tasks at once.

    It minimises a quadratic cost on the deviation from the task's reference. On a linear model without limits it
    converges in one iteration, to the Riccati solution.

    It takes input limits into account: every backward step minimises over the inputs within the limits, inputs at a
    limit get no feedback, and roll-outs are clipped. The controller clips its inputs on the model and on the system.

    Args:
        Q, R, Q_final: weights of the state, the input and the last state (Q by default), as diagonals or as matrices.
        iterations: largest number of steps for one task.
        tolerance: the iteration stops if the next step would lower the cost by less than this fraction of it.
        limits: limits of the inputs, rows ``[low, high]`` for each, or one number h for ``[-h, h]`` of all.
    """

    def __init__(
        self,
        Q: ArrayLike,
        R: ArrayLike,
        Q_final: ArrayLike | None = None,
        *,
        iterations: PositiveInt = 100,
        tolerance: PositiveFloat = 1e-8,
        limits: LimitsLike | None = None,
    ) -> None:
        super().__init__(QuadraticCost(Q, R, Q_final), limits)
        self.iterations, self.tolerance = iterations, tolerance

    def describe(self) -> dict[str, Any]:
        return {**super().describe(), "iterations": self.iterations, "tolerance": self.tolerance}

    def design(self, task: Task, model: Model) -> AffineFeedback:
        return self.solve(task, model).controller

    def solve(self, task: Task, model: Model) -> ILQRSolution:
        """Return the controller, and for each task the cost, the number of iterations and whether they converged."""
        self.cost.require_task(task)
        with np.errstate(all="ignore"):
            descent, batch = _Descent(self, task, model), task.batch_shape
            while len(rows := np.flatnonzero(descent.active)):
                descent.advance(rows)
            descent.undamp(np.flatnonzero(~descent.converged))
        gains, inputs, states = (
            np.moveaxis(array, 0, 1).reshape(*batch, len(array), *array.shape[2:])
            for array in (descent.K, descent.U, descent.X[:-1])
        )
        converged = descent.converged.reshape(batch)
        controller = AffineFeedback(gains, inputs, states, self.limits, converged)
        return ILQRSolution(controller, descent.J.reshape(batch), descent.iterations.reshape(batch), converged)


class _Descent:
    """The iterates of all tasks, time first: states X ``(H+1, N, n)``, inputs U ``(H, N, m)``."""

    def __init__(self, settings: ILQR, task: Task, model: Model) -> None:
        n, m = task.initial_state.shape[-1], len(settings.cost.R)
        self.settings, self.cost, self.model, self.limits = settings, settings.cost, model, settings.limits
        self.reference = np.moveaxis(task.reference.reshape(-1, task.horizon + 1, n), 1, 0)
        batch = self.reference.shape[1]
        self.U = np.zeros((task.horizon, batch, m))
        if self.limits is not None:
            self.U = self.limits.clip(self.U)
        self.X = np.empty((task.horizon + 1, batch, n))
        self.X[0] = task.initial_state.reshape(-1, n)
        step = run_of(model, self.X[0])
        for t in range(task.horizon):
            self.X[t + 1] = step(self.X[t], self.U[t])
        self.J = self.cost.value(self.X - self.reference, self.U)
        if not np.isfinite(self.J).all():
            raise DesignError("iLQR cannot start: the model diverges under zero input within the horizon.")
        self.K = np.zeros((task.horizon, batch, m, n))
        self.damping = np.zeros(batch)
        self.refused = np.zeros(batch, dtype=bool)  # the line search has failed at the present iterate
        self.shortened = np.zeros(batch, dtype=bool)  # the last step was not the full one
        self.iterations = np.zeros(batch, dtype=int)
        self.converged = np.zeros(batch, dtype=bool)
        # Steps of a plain function cost as much in a batch as one by one, so step lengths are not tried together.
        # Most tasks that need a shorter step need one of the first four.
        self.together = 4 if getattr(model, "vectorized", True) else 1
        self.latest: tuple[Rows, Array, Array] | None = None  # the latest derivatives, and their tasks

    @property
    def active(self) -> Mask:
        stuck = self.damping > 1e10  # no step improves the cost
        return ~self.converged & ~stuck & (self.iterations < self.settings.iterations)

    def advance(self, rows: Rows) -> None:
        around, policy = self._step(rows)
        gain = -(policy.slope + 0.5 * policy.curvature)
        arrived = gain <= self.settings.tolerance * (np.abs(self.J[rows]) + self.settings.tolerance)
        # A damped step is always small, so only an undamped step may mark a task as converged.
        self.converged[rows] = arrived & (self.damping[rows] == 0)
        self._keep(policy, np.flatnonzero(self.converged[rows]), rows)
        # If the line search has already refused the undamped step, no step improves the cost.
        self.damping[rows[arrived]] = np.where(self.refused[rows[arrived]], np.inf, 0.0)
        before = self.J[rows]
        moved = self._line_search(rows, policy, np.flatnonzero(~arrived))
        if around.linear and self.limits is None:
            # The model is linear, so the step was the exact minimiser, and its gains hold everywhere. If the cost was
            # far larger before, as on an unstable model, rounding errors call for another step. Up to this ratio the
            # relative error of the states is below 1e-10.
            self.converged[rows[moved]] = (before <= 1e12 * self.J[rows])[moved]

    def undamp(self, rows: Rows) -> None:
        """Give tasks that did not converge the gains of an undamped step at their last iterates.

        The gains of a damped step would be too small, and would depend on how often the damping grew. If the undamped
        step is not possible, the gains of the last accepted step remain.
        """
        if not len(rows):
            return
        self.damping[rows] = 0.0
        try:
            policy = self._step(rows)[1]
        except ModelError:
            for half in np.array_split(rows, 2) if len(rows) > 1 else ():
                self.undamp(half)
            return
        finite = np.isfinite(policy.K).all(axis=(0, -2, -1)) & np.ones(len(rows), dtype=bool)
        self._keep(policy, np.flatnonzero(finite), rows)

    def _step(self, rows: Rows) -> tuple[Expansion, InputStep]:
        X, U = self.X[:, rows], self.U[:, rows]
        known = self.latest  # the derivatives of unchanged iterates are kept
        if known is None or not self.refused[rows].all() or not np.array_equal(known[0], rows):
            known = self.latest = rows, *linearize(self.model, X[:-1], U)
        around = Expansion(X - self.reference[:, rows], U, *known[1:])
        return around, minimise(self.cost, around, self.limits, self.damping[rows])

    def _keep(self, policy: InputStep, chosen: Rows, rows: Rows) -> None:
        self.K[:, rows[chosen]] = policy.K[:, chosen] if policy.K.ndim == 4 else policy.K[:, None]

    def _line_search(self, rows: Rows, policy: InputStep, waiting: Rows) -> Rows:
        """Accept for each waiting task the longest step that lowers its cost; return the tasks with such a step."""
        moved, tried = [waiting[:0]], np.zeros(len(waiting), dtype=int)
        while len(waiting):
            # A task whose last step was the full one tries only this at first. Others try several lengths in one call.
            several = self.shortened[rows[waiting]] | (tried > 0)
            # Up to 256 loops on a model that takes batches, one more costs little.
            width = int(np.clip(256 // max(1, several.sum()), 1, self.together))
            counts = np.minimum(np.where(several, width, 1), len(_STEP_LENGTHS) - tried)
            accepted = self._try(rows, policy, waiting, tried, counts)
            moved.append(waiting[accepted])
            waiting, tried = waiting[~accepted], (tried + counts)[~accepted]
            exhausted = tried == len(_STEP_LENGTHS)
            refused = rows[waiting[exhausted]]
            self.damping[refused] = np.maximum(_LEAST_DAMPING, 10 * self.damping[refused])
            self.refused[refused] = self.shortened[refused] = True
            waiting, tried = waiting[~exhausted], tried[~exhausted]
        return np.concatenate(moved)

    def _try(self, rows: Rows, policy: InputStep, waiting: Rows, tried: Rows, counts: Rows) -> Mask:
        """Try the next ``counts`` step lengths of each waiting task in one call; return which tasks have moved."""
        of = np.repeat(np.arange(len(waiting)), counts)
        index = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts - tried, counts)
        lengths, tasks = _STEP_LENGTHS[index], waiting[of]
        # The model runs under u = u_old + length * k + K (x - x_old).
        X_old = self.X[:, rows[tasks]]
        U = self.U[:, rows[tasks]] + lengths[:, None] * policy.k[:, tasks]
        K = policy.K[:, tasks] if policy.K.ndim == 4 else policy.K
        X = np.empty_like(X_old)
        X[0], step = X_old[0], run_of(self.model, X_old[0])
        for t in range(len(U)):
            U[t] += fed_back(K[t], X[t] - X_old[t])
            if self.limits is not None:
                U[t] = self.limits.clip(U[t])
            X[t + 1] = step(X[t], U[t])
        J = self.cost.value(X - self.reference[:, rows[tasks]], U)
        J = np.where(np.isfinite(J), J, np.inf)
        expected = lengths * policy.slope[tasks] + 0.5 * lengths**2 * policy.curvature[tasks]
        good = np.flatnonzero(self.J[rows[tasks]] - J >= -1e-4 * expected)
        moved, first = np.unique(of[good], return_index=True)
        chosen, to = good[first], rows[waiting[moved]]
        self.X[:, to], self.U[:, to], self.J[to] = X[:, chosen], U[:, chosen], J[chosen]
        self._keep(policy, waiting[moved], rows)
        self.iterations[to] += 1
        self.refused[to] = False
        self.shortened[to] = index[chosen] > 0
        self.damping[to] = np.where(self.damping[to] > _LEAST_DAMPING, self.damping[to] / 10, 0.0)
        return np.isin(np.arange(len(waiting)), moved)


# The backward pass: minimisers of the quadratic expansion of the cost-to-go, for a batch of tasks. Input limits after
# control-limited differential dynamic programming (Tassa, Mansard and Todorov 2014).


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
