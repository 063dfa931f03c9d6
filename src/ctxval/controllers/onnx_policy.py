"""A trained policy from an ONNX file."""

from __future__ import annotations

from collections.abc import Callable
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
from ctxval.errors import InputError

Observe = Callable[[int, Array, Task], Array]


@part(files=("source",), functions={"observe": "(t, x, task) -> observations"})
class OnnxPolicy(ShortRepr):
    """A synthesizer that uses the same trained network for every task; the model is not used.

    The network takes one row of observations for each task and returns the inputs as its first output, such as the
    means of a stochastic policy. Nothing in the file is executed as code.

    Args:
        source: the file, or its bytes.
        observe: function ``(t, x, task) -> observations (..., k)`` of the step's index, the states ``(..., n)`` and
            the task; by default the observations are the states.
        scale: factor of the network's outputs, a number or ``(m,)``: with a scale of 5 a policy in ``[-1, 1]`` drives
            a motor of 5 N m.
        limits: limits to which inputs are clipped, in a form of :meth:`Limits.of`, such as one number h for -h to h.
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
        self.network = OnnxNetwork(source)
        self.observe = observe
        self.scale = scale
        self.limits = None if limits is None else Limits.of(limits)
        if len(self.network.widths) != 1:
            names = ", ".join(self.network.names)
            raise InputError(f"a policy must have one input, the observations, but the network has {names}.")

    def inputs(self, t: int, x: Array, task: Task) -> Array:
        """Return the inputs ``(..., m)`` at step t before they are clipped."""
        observations: Any = x if self.observe is None else self.observe(t, x, task)
        return self.network(np.asarray(observations, dtype=np.float64)) * self.scale

    def design(self, task: Task, model: Model) -> BoundPolicy:
        return BoundPolicy(self.inputs, task, self.limits)

    def describe(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("network", "observe", "scale", "limits")}
