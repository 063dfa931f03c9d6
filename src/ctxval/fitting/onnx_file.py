"""A network as an ONNX file, in double precision, for robots and other programs. Needs onnx (extra ``fit``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.extras import require_extra
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.models import FeedforwardReLU, Linear

_OPSET, _IR = 17, 8
"""Versions that onnxruntime has read since 2022."""


def write_onnx(path: str | Path, model: Model) -> None:
    """Write a network or a linear model as an ONNX file with one input ``(x, u)`` and the output ``x_next``.

    Args:
        path: the file.
        model: a ``FeedforwardReLU`` or ``Linear``.

    Raises:
        InputError: if onnx is not installed, the model is another one, or the file cannot be written.
    """
    onnx = require_extra("onnx", "fit", "ONNX files")
    graph = _Graph(onnx)
    if isinstance(model, Linear):
        n, m = model.B.shape
        graph.affine("z", np.concatenate([model.A, model.B], axis=1).T, model.c, "x_next")
    elif isinstance(model, FeedforwardReLU):
        n = len(model.scaling.shift_out)
        m = len(model.scaling.shift_in) - n
        _network(graph, model, n)
    else:
        raise InputError(f"only networks and linear models can be written as ONNX, got {model!r}.")
    value = onnx.helper.make_tensor_value_info
    kind = onnx.TensorProto.DOUBLE
    made = onnx.helper.make_graph(
        graph.nodes, "step", [value("z", kind, ["N", n + m])], [value("x_next", kind, ["N", n])], graph.tensors
    )
    opset = [onnx.helper.make_opsetid("", _OPSET)]
    try:
        onnx.save(onnx.helper.make_model(made, opset_imports=opset, ir_version=_IR), str(path))
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error


def _network(graph: _Graph, model: FeedforwardReLU, n: int) -> None:
    scaling = model.scaling
    graph.affine("z", np.diag(1 / scaling.scale_in), -scaling.shift_in / scaling.scale_in, "h0")
    last = len(model.weights) - 1
    for i, (weight, bias) in enumerate(zip(model.weights, model.biases, strict=True)):
        graph.affine(f"h{i}", weight, bias, f"a{i}")
        if i < last:
            graph.node("Relu", [f"a{i}"], f"h{i + 1}")
    graph.affine(f"a{last}", np.diag(scaling.scale_out), scaling.shift_out, "change")
    graph.affine("z", np.eye(len(scaling.shift_in))[:, :n], np.zeros(n), "x")
    graph.node("Add", ["x", "change"], "x_next")


class _Graph:
    """The nodes and constants of a graph."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.tensors: list[Any] = []

    def node(self, kind: str, inputs: list[str], output: str) -> None:
        self.nodes.append(self._onnx.helper.make_node(kind, inputs, [output]))

    def affine(self, source: str, weight: Array, bias: Array, output: str) -> None:
        """Add ``output = source @ weight + bias``."""
        names = [f"{output}_weight", f"{output}_bias"]
        for name, array in zip(names, (weight, bias), strict=True):
            self.tensors.append(self._onnx.numpy_helper.from_array(np.asarray(array, dtype=np.float64), name))
        self.node("Gemm", [source, *names], output)
