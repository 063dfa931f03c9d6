"""Feedback of states that are estimated from outputs by a Kalman filter on M."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller, Limits, Synthesizer, memory_of, stepped
from ctxval.core.kalman import Estimate, corrected, predicted
from ctxval.core.model import Model
from ctxval.core.system import Outputs, OutputsLike
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError


@part(functions={"outputs": "x -> y"}, parts={"synthesizer": "synthesizer"})
class OutputFeedback(ShortRepr):
    """A state feedback on the estimate of an extended Kalman filter of M, which sees outputs alone.

    The goal or reference of the task is one of the outputs. The state feedback follows the states of least norm that
    have these outputs, by the linearisation of the outputs at zero states.

    Args:
        synthesizer: designs the state feedback, as LQR does.
        outputs: a function ``h(x) -> y`` of M's states, or the indices of the states that are outputs.
        process: standard deviations of what M misses in each state in one step, a number or ``(n,)``.
        measurement: standard deviations of the errors of the outputs, a number or ``(p,)``.

    Raises:
        InputError: if a standard deviation is not positive.
    """

    def __init__(
        self, synthesizer: Synthesizer, outputs: OutputsLike, *, process: ArrayLike, measurement: ArrayLike
    ) -> None:
        self.synthesizer, self.outputs = synthesizer, Outputs(outputs)
        self.process, self.measurement = as_finite("process", process), as_finite("measurement", measurement)
        for name in ("process", "measurement"):
            if not (getattr(self, name) > 0).all():
                raise InputError(f"{name} must be positive, got {getattr(self, name).tolist()}.")

    @property
    def batched(self) -> bool:
        return bool(getattr(self.synthesizer, "batched", False))

    def design(self, task: Task, model: Model) -> EstimatedFeedback:
        n, p = task.initial_state.shape[-1], self.outputs(task.initial_state).shape[-1]
        task.require_width(p, "the outputs")
        zero = np.zeros(n)
        lift = np.linalg.pinv(self.outputs.jacobian(zero)).T
        reference = (task.reference - self.outputs(zero)) @ lift if task.has_goal else None
        start, more = task.initial_state, {"name": task.name, "environment": task.environment}
        of_states = Task(start, horizon=task.horizon, dt=task.dt, reference=reference, **more)
        covariances = []
        for name, value, size in (("process", self.process, n), ("measurement", self.measurement, p)):
            if value.shape not in ((), (size,)):
                raise ShapeError(f"{name} must be a number or have shape ({size},), got {value.shape}.")
            covariances.append(np.diag(np.broadcast_to(value, (size,)) ** 2))
        return EstimatedFeedback(self.synthesizer.design(of_states, model), model, self.outputs, *covariances)


class FilterMemory(NamedTuple):
    """The estimate before the next outputs, and the memory of the state feedback."""

    prior: Estimate
    of_feedback: Any


@dataclass(frozen=True, eq=False)
class EstimatedFeedback(ShortRepr):
    """The state feedback of one task or a batch on the filter's estimates, a controller with memory."""

    feedback: Controller
    model: Model
    outputs: Outputs
    process: Array  # covariances (n, n) and (p, p)
    measurement: Array

    @property
    def limits(self) -> Limits | None:
        return getattr(self.feedback, "limits", None)

    @property
    def converged(self) -> Any:
        return getattr(self.feedback, "converged", None)

    def start(self, task: Task) -> FilterMemory:
        known = np.broadcast_to(self.process, (*task.batch_shape, *self.process.shape))
        return FilterMemory(Estimate(np.array(task.initial_state), known), memory_of(self.feedback, task))

    def step(self, t: int, y: Array, memory: FilterMemory) -> tuple[Array, FilterMemory]:
        """Return the inputs ``(..., m)`` for the outputs ``(..., p)`` of step t, and the new memory."""
        known, _ = corrected(self.outputs, memory.prior, np.asarray(y, dtype=np.float64), self.measurement)
        u, of_feedback = stepped(self.feedback, t, known.mean, memory.of_feedback)
        u = np.asarray(u, dtype=np.float64)
        prior, _ = predicted(self.model, known, u, self.process)
        return u, FilterMemory(prior, of_feedback)

    def __getitem__(self, index: int) -> EstimatedFeedback:
        feedback: Any = self.feedback
        return EstimatedFeedback(feedback[index], self.model, self.outputs, self.process, self.measurement)
