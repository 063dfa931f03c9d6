"""Iterative LQR (Li and Todorov 2004; regularisation and line search after Tassa, Erez and Todorov 2012)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Mask, Rows
from ctxval._util.checked import PositiveFloat, PositiveInt
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.controllers.backward_pass import Expansion, InputStep, minimise
from ctxval.controllers.lqr import QuadraticCost, QuadraticSynthesizer
from ctxval.core.controller import AffineFeedback, LimitsLike, fed_back
from ctxval.core.model import Model, linearize
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
        limits: limits of the inputs, in a form of :meth:`Limits.of`, such as one number h for -h to h.
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
        for t in range(task.horizon):
            self.X[t + 1] = model.step(self.X[t], self.U[t])
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
        """Accept for each waiting task the longest step that lowers its cost; return the tasks with such a step.

        A task whose last step was the full one tries only this at first. Others try several lengths in one call.
        """
        moved, tried = [waiting[:0]], np.zeros(len(waiting), dtype=int)
        while len(waiting):
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
        X[0] = X_old[0]
        for t in range(len(U)):
            U[t] += fed_back(K[t], X[t] - X_old[t])
            if self.limits is not None:
                U[t] = self.limits.clip(U[t])
            X[t + 1] = self.model.step(X[t], U[t])
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
