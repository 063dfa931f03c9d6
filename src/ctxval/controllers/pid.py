"""PID control of chosen states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite
from ctxval._util.checked import NonNegativeFloat
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Limits, LimitsLike, fed_back
from ctxval.core.model import Model
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError


@part()
class PID(ShortRepr):
    """Proportional, integral and derivative control of chosen states towards the task's reference; M is not used.

    With the error ``e = r - y`` of the chosen states y, the input is ``u = bias + kp e + ki integral(e) - kd dy/dt``,
    clipped to the limits. The integral is the sum of the errors so far, the present one included, times dt. The
    derivative is that of the states, so that a step of the reference causes no peak; it is a backward difference, and 0
    at the first step. Anti-windup by clamping: the integral of an input stops growing as soon as the input reaches its
    limit, and it shrinks freely.

    Args:
        kp, ki, kd: gains. A number, or one for each chosen state, is for one input per chosen state, in this order. A
            matrix ``(m, k)`` is for m inputs and k chosen states.
        components: the indices of the k chosen states.
        bias: inputs that are added, such as those that hold the weight of an arm, a number or ``(m,)``.
        derivative_filter: time constant in seconds of the low-pass filter of the derivative; 0 is no filter.
        limits: limits of the inputs, rows ``[low, high]`` for each, or one number h for ``[-h, h]`` of all.

    Raises:
        InputError: if components are no different indices.
        ShapeError: if gains or bias have other shapes.
    """

    batched = True

    def __init__(
        self,
        kp: ArrayLike,
        ki: ArrayLike = 0.0,
        kd: ArrayLike = 0.0,
        *,
        components: Sequence[int] = (0,),
        bias: ArrayLike = 0.0,
        derivative_filter: NonNegativeFloat = 0.0,
        limits: LimitsLike | None = None,
    ) -> None:
        self.components = tuple(int(i) for i in components)
        if not self.components or len(set(self.components)) < len(self.components) or min(self.components) < 0:
            raise InputError(f"components must be different indices of states, from 0, got {list(components)}.")
        self.kp, self.ki, self.kd = _gains({"kp": kp, "ki": ki, "kd": kd}, len(self.components))
        inputs = len(self.kp)
        self.bias = as_finite("bias", bias)
        if self.bias.shape not in ((), (inputs,)):
            raise ShapeError(f"bias must be a number, or one for each of {inputs} inputs, got {self.bias.tolist()}.")
        self.derivative_filter = derivative_filter
        self.limits = None if limits is None else Limits.of(limits, inputs)

    def design(self, task: Task, model: Model) -> PIDFeedback:
        """Return the controller that follows the chosen states of the task's reference.

        Raises:
            InputError: if a component is no state of the task.
        """
        n = task.initial_state.shape[-1]
        if max(self.components) >= n:
            raise InputError(f"components must be indices of the task's {n} states, got {list(self.components)}.")
        return PIDFeedback(self, task.reference[..., self.components], task.dt)


class PIDMemory(NamedTuple):
    """What a PID controller remembers of earlier steps."""

    integral: Array  # the integral part of each input (..., m)
    states: Array  # the chosen states at the last step (..., k)
    derivative: Array  # the filtered derivative of the chosen states (..., k)


@dataclass(frozen=True, eq=False)
class PIDFeedback(ShortRepr):
    """The PID controller of one task or a batch, a controller with memory."""

    pid: PID
    reference: Array  # of the chosen states (..., H + 1, k)
    dt: float  # seconds

    @property
    def limits(self) -> Limits | None:
        return self.pid.limits

    def start(self, task: Task) -> PIDMemory:
        """Return a memory without any integral and derivative."""
        m, k = self.pid.kp.shape
        return PIDMemory(*(np.zeros((*task.batch_shape, size)) for size in (m, k, k)))

    def step(self, t: int, x: Array, memory: PIDMemory) -> tuple[Array, PIDMemory]:
        """Return the inputs ``(..., m)`` at step t, and the new memory."""
        pid, y = self.pid, np.asarray(x, dtype=np.float64)[..., self.pid.components]
        error = self.reference[..., min(t, self.reference.shape[-2] - 1), :] - y
        derivative = memory.derivative
        if t:
            rate = (y - memory.states) / self.dt
            derivative = derivative + (rate - derivative) * (self.dt / (pid.derivative_filter + self.dt))
        growth = fed_back(pid.ki, error) * self.dt
        u = pid.bias + fed_back(pid.kp, error) - fed_back(pid.kd, derivative) + memory.integral
        if pid.limits is not None:
            # Clamping: growth stops where the input reaches its limit. Unlike a switch this is continuous in the
            # states, so that neighbouring tasks have neighbouring inputs.
            growth = np.clip(growth, np.minimum(pid.limits.low - u, 0.0), np.maximum(pid.limits.high - u, 0.0))
        u = u + growth
        new = PIDMemory(memory.integral + growth, y, derivative)
        return (u if pid.limits is None else pid.limits.clip(u)), new

    def __getitem__(self, index: int) -> PIDFeedback:
        return replace(self, reference=self.reference[index])


def _gains(given: dict[str, ArrayLike], states: int) -> list[Array]:
    """Return gains as matrices ``(m, k)`` of one shape."""
    gains = {name: as_finite(name, gain) for name, gain in given.items()}
    shapes = {gain.shape for gain in gains.values() if gain.ndim == 2} or {(states, states)}
    shape = min(shapes)
    for name, gain in gains.items():
        if len(shapes) > 1 or shape[1] != states or (gain.ndim == 2 and not gain.size):
            wanted = f"matrices of one shape (m, {states}), for m inputs and {states} chosen states"
            raise ShapeError(f"kp, ki and kd must be {wanted}, got {', '.join(map(str, sorted(shapes)))}.")
        square = shape[0] == states
        if gain.ndim < 2 and not (gain.shape in ((), (states,)) and (square or not gain.any())):
            wanted = f"a number, or one for each of {states} chosen states" if square else f"a matrix of shape {shape}"
            raise ShapeError(f"{name} must be {wanted}, got {gain.tolist()}.")
    return [
        gain if gain.ndim == 2 else np.eye(states) * gain if shape[0] == states else np.zeros(shape)
        for gain in gains.values()
    ]
