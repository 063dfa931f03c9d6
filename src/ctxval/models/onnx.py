"""A learned model from an ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.onnx_network import OnnxNetwork
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.model import central_differences, paired
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError


@part(files=("source",))
class Onnx(ShortRepr):
    """A network from an ONNX file as a model; any toolbox may have written the file.

    The network takes the state and the input as two inputs in this order, or as one input with the state first. It
    runs with onnxruntime; nothing in the file is executed as code.

    In single precision the rounding hides differences of 1e-5. The Jacobian is therefore taken by central differences
    with wider steps, which give about three correct digits.

    Args:
        source: the file, or its bytes.
        increments: whether the network returns ``x_next - x`` instead of ``x_next``.
        data: the transitions that the network was learned from, if they are known.
    """

    def __init__(
        self, source: str | Path | bytes, *, increments: bool = False, data: Transitions | None = None
    ) -> None:
        self.network = OnnxNetwork(source)
        self.data = data
        self.increments = increments
        if len(self.network.widths) not in (1, 2):
            raise InputError(
                f"a model must take (x, u) as one or two inputs, but the network has {', '.join(self.network.names)}."
            )

    def step(self, x: Array, u: Array) -> Array:
        pair = (x, u) if len(self.network.widths) == 2 else (np.concatenate(paired(x, u), axis=-1),)
        output = self.network(*pair)
        if output.shape[-1] != x.shape[-1]:
            raise ShapeError(
                f"the network must return as many states as it takes, {x.shape[-1]}, got {output.shape[-1]}."
            )
        return x + output if self.increments else output

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return A ``(..., n, n)`` and B ``(..., n, m)`` by central differences that suit the network's precision."""
        return central_differences(self.step, *paired(x, u), self.network.precision)

    def describe(self) -> dict[str, Any]:
        return {**self.network.describe(), "increments": self.increments}
