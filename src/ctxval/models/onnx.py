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
    """A network from an ONNX file as a model; any toolbox may have written the file, and nothing in it is run as code.

    The network takes the state and the input as two inputs in this order, or as one input with the state first. Its
    Jacobian is taken by central differences that suit its precision; in single precision about three digits are
    correct.

    Args:
        source: the file, or its bytes.
        increments: whether the network returns ``x_next - x`` instead of ``x_next``.
        data: the transitions that the network was learned from, if they are known.
    """

    def __init__(
        self, source: str | Path | bytes, *, increments: bool = False, data: Transitions | None = None
    ) -> None:
        self.network, self.increments, self.data = OnnxNetwork(source), increments, data
        if len(self.network.widths) not in (1, 2):
            names = ", ".join(self.network.names)
            raise InputError(f"a model must take (x, u) as one or two inputs, but the network has {names}.")

    def step(self, x: Array, u: Array) -> Array:
        pair = (x, u) if len(self.network.widths) == 2 else (np.concatenate(paired(x, u), axis=-1),)
        output = self.network(*pair)
        if output.shape[-1] != x.shape[-1]:
            got = f"{x.shape[-1]}, got {output.shape[-1]}"
            raise ShapeError(f"the network must return as many states as it takes, {got}.")
        return x + output if self.increments else output

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        return central_differences(self.step, *paired(x, u), self.network.precision)

    def describe(self) -> dict[str, Any]:
        return {**self.network.describe(), "increments": self.increments}
