"""Model predictive control with limits on inputs and states, on any model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Mask, as_floats
from ctxval._util.checked import PositiveFloat, PositiveInt
from ctxval._util.refusals import require_extra
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.controllers.lqr import QuadraticCost
from ctxval.core.controller import Limits, LimitsLike
from ctxval.core.model import Model, linearize
from ctxval.core.task import Task
from ctxval.errors import DesignError, ShapeError


@part()
class MPC(ShortRepr):
    """Receding-horizon control that plans with limits, by sequential quadratic programming in CasADi.

    At every step it minimises the quadratic cost of the model's prediction over the next steps, relative to the task's
    reference (held beyond its end), and applies the first input. On a linear model one quadratic program gives the
    exact solution. Other models are linearised along the prediction, up to ``iterations`` times, with a line search.
    The input depends only on the step and the state: no call depends on an earlier one.

    Input limits are never exceeded. State limits hold for the model's predictions; if the system differs from the model
    and no inputs lead back at once, the problem has no solution, which is an error. A ``violation_cost`` makes the
    state limits soft, so that there is always a solution.

    Args:
        Q, R, Q_final: weights of the state, the input and the last state (Q by default), as diagonals or as matrices.
        steps: number of predicted steps.
        limits: limits of the inputs, rows ``[low, high]`` for each, or one number h for ``[-h, h]`` of all.
        state_limits: limits of the states, written in the same way; infinite for states without limits.
        violation_cost: cost of exceeding the state limits by 1, for each predicted step; None makes them hard.
        iterations: largest number of quadratic programs for one input.
    """

    batched = False

    def __init__(
        self,
        Q: ArrayLike,
        R: ArrayLike,
        Q_final: ArrayLike | None = None,
        *,
        steps: PositiveInt,
        limits: LimitsLike | None = None,
        state_limits: LimitsLike | None = None,
        violation_cost: PositiveFloat | None = None,
        iterations: PositiveInt = 20,
    ) -> None:
        self.cost = QuadraticCost(Q, R, Q_final)
        n, m = len(self.cost.Q), len(self.cost.R)
        self.steps, self.iterations = steps, iterations
        self.limits = Limits.of(np.inf if limits is None else limits, m)
        self.state_limits = Limits.of(np.inf if state_limits is None else state_limits, n)
        self.violation_cost = violation_cost
        require_extra("casadi", "mpc", "MPC controllers need")

    def design(self, task: Task, model: Model) -> RecedingHorizon:
        self.cost.require_task(task)
        if task.batch_shape:
            raise ShapeError(f"MPC designs for one task at a time, got a batch of shape {task.batch_shape}.")
        return RecedingHorizon(self, task, model)


@dataclass(frozen=True, eq=False)
class RecedingHorizon(ShortRepr):
    """The controller of :class:`MPC` for one task."""

    settings: MPC
    task: Task
    model: Model

    def __call__(self, t: int, x: Array) -> Array:
        first: Array = self.plan(t, x)[1][0]
        return first

    def plan(self, t: int, x: Array) -> tuple[Array, Array]:
        """Return the predicted states ``(steps + 1, n)`` and the planned inputs ``(steps, m)``.

        Raises:
            DesignError: if no inputs keep the limits, or the prediction is not finite.
        """
        settings, limits, bounds = self.settings, self.settings.limits, self.settings.state_limits
        rows = np.minimum(t + 1 + np.arange(settings.steps), self.task.horizon)
        start, reference, R = as_floats("the state", x), self.task.reference[rows], settings.cost.R
        Q = np.stack([*[settings.cost.Q] * (settings.steps - 1), settings.cost.Q_final])
        weight = 0.0  # of what exceeds the state limits

        def predicted(U: Array) -> Array:
            X = np.empty((len(U) + 1, len(start)))
            X[0] = start
            for k, u in enumerate(U):
                X[k + 1] = self.model.step(X[k], u)
            return X

        def merit(X: Array, U: Array) -> float:
            deviations = X[1:] - reference
            weighed = ((Q @ deviations[..., None])[..., 0] * deviations).sum()
            cost = 0.5 * (weighed + ((U @ R) * U).sum())
            excess = np.maximum(np.maximum(bounds.low - X[1:], X[1:] - bounds.high), 0.0)
            violation = excess.sum() if settings.violation_cost is None else excess.max(axis=-1).sum()
            value = float(cost + weight * violation)
            return value if np.isfinite(value) else np.inf

        with np.errstate(all="ignore"):
            U = limits.clip(np.zeros((settings.steps, len(R))))
            X = predicted(U)
            if not np.isfinite(X).all():
                raise DesignError(f"MPC cannot start at step {t}: the prediction from {start.tolist()} is not finite.")
            for _ in range(settings.iterations):
                A, B = linearize(self.model, X[:-1], U)
                solution = _best_change(settings, Q, X, U, A, B, reference)
                if solution is None:
                    aim = f"that keep the prediction from {start.tolist()} within the state limits"
                    raise DesignError(f"MPC finds no inputs at step {t} {aim}; a violation_cost makes them soft.")
                change, largest = solution
                if A.ndim == 2 and B.ndim == 2:
                    U = limits.clip(U + change)
                    return predicted(U), U
                weight = max(weight, 2.0 * largest) if settings.violation_cost is None else settings.violation_cost
                before = merit(X, U)
                for length in 0.5 ** np.arange(10):
                    U_new = limits.clip(U + length * change)
                    X_new = predicted(U_new)
                    if (after := merit(X_new, U_new)) < before:
                        break
                else:
                    break
                X, U = X_new, U_new
                if before - after <= 1e-9 * (1 + abs(before)):
                    break
            return X, U


def _best_change(
    settings: MPC, Q: Array, X: Array, U: Array, A: Array, B: Array, reference: Array
) -> tuple[Array, float] | None:
    """Return the best change of the inputs ``(steps, m)`` for the linearised prediction, and the largest multiplier."""
    (steps, m), bounds, soft = U.shape, settings.state_limits, settings.violation_cost
    limited: Mask = np.isfinite(bounds.low) | np.isfinite(bounds.high)
    G = np.zeros((steps, B.shape[-2], steps * m))  # the derivatives of the states 1 to ``steps`` by all inputs
    for k in range(steps):
        A_k, B_k = A if A.ndim == 2 else A[k], B if B.ndim == 2 else B[k]
        if k:
            G[k] = A_k @ G[k - 1]
        G[k, :, k * m : (k + 1) * m] = B_k
    QG = Q @ G
    hessian = np.tensordot(G, QG, axes=([0, 1], [0, 1])) + np.kron(np.eye(steps), settings.cost.R)
    slope = np.tensordot(X[1:] - reference, QG, axes=([0, 1], [0, 1])) + (U @ settings.cost.R).ravel()
    rows = G[:, limited].reshape(-1, steps * m)
    box = (settings.limits.low - U).ravel(), (settings.limits.high - U).ravel()
    gaps = (bounds.low - X[1:])[:, limited].ravel(), (bounds.high - X[1:])[:, limited].ravel()
    if soft is None or not len(rows):
        solution = _quadratic_program(hessian, slope, rows, box, gaps)
    else:
        solution = _softened(hessian, slope, rows, box, gaps, soft, steps)
    return None if solution is None else (solution[0][: steps * m].reshape(steps, m), solution[1])


def _softened(
    hessian: Array, slope: Array, rows: Array, box: Sequence[Array], gaps: Sequence[Array], cost: float, steps: int
) -> tuple[Array, float] | None:
    """Solve with one slack variable for each step, by which the state limits may be exceeded."""
    size, count = len(slope), len(rows)
    whole = np.zeros((size + steps, size + steps))
    whole[:size, :size] = hessian
    whole[size:, size:] = 1e-6 * cost * np.eye(steps)  # keeps the problem strictly convex
    slack = np.kron(np.eye(steps), np.ones((count // steps, 1)))
    unlimited = np.full(count, np.inf)
    return _quadratic_program(
        whole,
        np.concatenate([slope, np.full(steps, cost)]),
        np.block([[rows, slack], [rows, -slack]]),
        (np.append(box[0], np.zeros(steps)), np.append(box[1], np.full(steps, np.inf))),
        (np.append(gaps[0], -unlimited), np.append(unlimited, gaps[1])),
    )


def _quadratic_program(
    hessian: Array, slope: Array, rows: Array, box: Sequence[Array], gaps: Sequence[Array]
) -> tuple[Array, float] | None:
    """Minimise ``1/2 z'Hz + g'z``, z in a box and ``rows z`` in the gaps; return z and the largest multiplier."""
    casadi = require_extra("casadi", "mpc", "MPC controllers need")
    dense = casadi.Sparsity.dense
    sizes = {"h": dense(*hessian.shape), "a": dense(len(rows), len(slope))}
    # DAQP is an active-set method, exact up to rounding, and prints nothing.
    solver = casadi.conic("mpc", "daqp", sizes, {"error_on_fail": False})
    solution = solver(h=hessian, g=slope, a=rows, lbx=box[0], ubx=box[1], lba=gaps[0], uba=gaps[1])
    if not solver.stats()["success"]:
        return None
    multipliers = np.abs(np.array(solution["lam_a"]).ravel())
    return np.array(solution["x"], dtype=np.float64).ravel(), float(multipliers.max(initial=0.0))
