"""Which Jacobian controllers are designed with, and whose controllers on executed tasks have not changed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval.core.model import linearize
from ctxval.core.plan import gives_inputs
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError
from ctxval.learning.recorded import closed_loops_on_model
from ctxval.models import Corrected, Linear, Refined


@dataclass(frozen=True)
class SameControllers:
    """Executed tasks of earlier rounds on which the refined model has the controller that was executed.

    The distance of the refined model on such a task is known without another execution, if the system is
    deterministic. The model has learned from them, so they can falsify it, and they never count for it.
    """

    tasks: int = 0  #: number of executed tasks that were compared, and of those with numerically the same controller
    same: int = 0
    worst: float | None = None  #: the largest distance of the refined model on the latter; None if there are none


def with_best_jacobian(validation: Validation, refined: Refined) -> tuple[Refined, str | None]:
    """Return a refined model with the Jacobian whose controllers complete the tasks best on the refined model itself.

    A synthesizer that linearises once, such as LQR, needs a linear model that is good on the whole task. If M is
    linear, it is such a model, and the Jacobian of a nonlinear M' at one point may be none. It is used only if random
    tasks have a clearly smaller cost on M' with it. Nothing is executed.
    """
    model = refined.model
    if not isinstance(model, Corrected) or not isinstance(model.model, Linear):
        return refined, None
    if not _linearises_once(validation, model.model):
        return refined, None
    other = Corrected(model.model, model.correction, linearised="model", data=model.data)
    kept = Refined(other, refined.data, refined.before)
    costs = [_typical_cost(validation.with_parts(model=either)) for either in (refined, kept)]
    if costs[0] <= 0.95 * costs[1]:  # clearly
        return refined, None
    return kept, (
        "controllers are designed with the Jacobian of the model before, and the prediction is corrected: the "
        "synthesizer linearises once, and the tasks are not completed clearly better on the refined model with its own "
        f"Jacobian (their cost is {costs[0]:.3g} with it, and {costs[1]:.3g} without)"
    )


def _linearises_once(validation: Validation, model: Linear) -> bool:
    """Return whether the design of one controller asks for the Jacobian of M at one or two points."""

    class Counted:
        points = 0

        def step(self, x: Array, u: Array) -> Array:
            return model.step(x, u)

        def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
            batch = x.shape[:-1]
            self.points += int(np.prod(batch))
            A, B = linearize(model, x, u)
            return np.broadcast_to(A, (*batch, *A.shape[-2:])), np.broadcast_to(B, (*batch, *B.shape[-2:]))

    counted = Counted()
    with suppress(CtxvalError):
        validation.with_parts(model=counted).plan(validation.space.from_unit(np.full(validation.space.dimension, 0.5)))
        return 1 <= counted.points <= 2
    return False


def _typical_cost(validation: Validation) -> float:
    """Return the median cost of random tasks on a model; infinity if their controllers cannot be designed."""
    space, rng = validation.space, np.random.default_rng(0)
    # Users' tasks, synthesizers and costs may raise anything, on tasks that may never be executed.
    with suppress(Exception), single_threaded():
        loops = closed_loops_on_model(validation)
        if loops is None or loops.states.ndim == 2:  # designs cannot be made in a batch
            plans = map(validation.plan, space.from_unit(rng.random((8, space.dimension))))
            return float(np.median([_cost(validation, plan.task, plan.model_trajectory) for plan in plans]))
        points = space.from_unit(rng.random((len(loops.states), space.dimension)))
        costs = _cost(validation, validation.task_at(space.parameters(points)), loops)
        return float(np.median(costs)) if np.isfinite(costs).all() else np.inf
    return np.inf


def _cost(validation: Validation, task: Task, loops: Trajectory) -> Array:
    """Return the cost of closed loops: that of the synthesizer, or else the squared deviation from the reference."""
    deviations = np.moveaxis(loops.states - task.reference, -2, 0)
    value = getattr(getattr(validation.synthesizer, "cost", None), "value", None)
    if callable(value):
        return np.asarray(value(deviations, np.moveaxis(loops.inputs, -2, 0)))
    sizes = np.maximum(np.abs(loops.states).reshape(-1, loops.states.shape[-1]).std(axis=0), 1e-12)
    return np.asarray(((deviations / sizes) ** 2).sum(axis=(0, -1)))


def same_controllers(validation: Validation, executed: Sequence[tuple[Trial, Trajectory]]) -> SameControllers:
    """Return on how many executed tasks the controllers of a refined model are those that were executed."""
    distances, recent = list[float](), executed[-32:]
    for trial, recorded in recent:
        with suppress(Exception):  # users' parts may raise anything: what cannot be compared differs
            plan = validation.plan(validation.space.from_unit(trial.unit_point))
            if gives_inputs(plan, recorded, 1e-6):  # a share of the largest magnitude of each input
                distances.append(validation.accept(plan, recorded))
    return SameControllers(len(recent), len(distances), max(distances, default=None))
