"""A trained policy from an ONNX file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.onnx_network import OnnxNetwork
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import BoundPolicy, Limits, LimitsLike
from ctxval.core.model import Model
from ctxval.core.task import Task

Observe = Callable[[int, Array, Task], Array]


@part(files=("source",), functions={"observe": "(t, x, task) -> observations"})
class OnnxPolicy(ShortRepr):
    """A synthesizer that uses the same trained network for every task; the model is not used.

    The network takes one row of observations for each task and returns the inputs as its first output, such as the
    means of a stochastic policy. Nothing in the file is executed as code.

    A recurrent network has states besides: they are all inputs after the observations, and the new states are the last
    outputs, in the same order. They are 0 at the first step, and the controller remembers them. Their shapes are
    ``(N, k)``, or ``(L, N, k)`` for L layers.

    Args:
        source: the file, or its bytes.
        observe: function ``(t, x, task) -> observations (..., k)`` of the step's index, the states ``(..., n)`` and
            the task; by default the observations are the states.
        scale: factor of the network's outputs, a number or ``(m,)``: with a scale of 5 a policy in ``[-1, 1]`` drives
            a motor of 5 N m.
        limits: limits of the inputs, rows ``[low, high]`` for each, or one number h for ``[-h, h]`` of all.
    """

    batched = True

    def __init__(
        self,
        source: str | Path | bytes,
        *,
        observe: Observe | None = None,
        scale: float | Array = 1.0,
        limits: LimitsLike | None = None,
    ) -> None:
        self.network, self.observe, self.scale = OnnxNetwork(source, recurrent=True), observe, scale
        self.limits = None if limits is None else Limits.of(limits)

    def inputs(self, t: int, x: Array, task: Task) -> Array:
        """Return the inputs ``(..., m)`` at step t before they are clipped, of a network without states."""
        return self.network(self.observations(t, x, task)) * self.scale

    def observations(self, t: int, x: Array, task: Task) -> Array:
        """Return what the network observes at step t, ``(..., k)``."""
        observed: Any = x if self.observe is None else self.observe(t, x, task)
        return np.asarray(observed, dtype=np.float64)

    def design(self, task: Task, model: Model) -> BoundPolicy | RecurrentPolicy:
        if len(self.network.widths) > 1:
            return RecurrentPolicy(self, task)
        return BoundPolicy(self.inputs, task, self.limits)

    def describe(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("network", "observe", "scale", "limits")}


@dataclass(frozen=True, eq=False)
class RecurrentPolicy(ShortRepr):
    """The controller of a recurrent network for one task or a batch; its memory are the states of the network."""

    policy: OnnxPolicy
    task: Task

    @property
    def limits(self) -> Limits | None:
        return self.policy.limits

    def start(self, task: Task) -> tuple[Array, ...]:
        return tuple(np.zeros((*task.batch_shape, width or 0)) for width in self.policy.network.widths[1:])

    def step(self, t: int, x: Array, memory: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Return the inputs ``(..., m)`` at step t, within the limits, and the new states of the network."""
        u, *new = self.policy.network.outputs(self.policy.observations(t, x, self.task), *memory)
        u = u * self.policy.scale
        return (u if self.limits is None else Limits.of(self.limits, u.shape[-1]).clip(u)), tuple(new)

    def __getitem__(self, index: int) -> RecurrentPolicy:
        return RecurrentPolicy(self.policy, self.task[index])
