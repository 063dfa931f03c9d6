"""A model as an ONNX file, in double precision, for robots and other programs. Needs onnx (extra ``fit``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.extras import require_extra
from ctxval._util.files import MADE_BY, written_whole
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.models import Corrected, Correction, FeedforwardReLU, GaussianProcessModel, Linear

_OPSET, _IR = 17, 8  # versions that onnxruntime has read since 2022


def write_onnx(path: str | Path, model: Model) -> None:
    """Write a model as an ONNX file with one input ``(x, u)`` and the output ``x_next``."""
    onnx = require_onnx(model)
    graph = _Graph(onnx)
    n, m = _model(graph, model, "x_next")
    value = onnx.helper.make_tensor_value_info
    kind = onnx.TensorProto.DOUBLE
    made = onnx.helper.make_graph(
        graph.nodes, "step", [value("z", kind, ["N", n + m])], [value("x_next", kind, ["N", n])], graph.tensors
    )
    opset = [onnx.helper.make_opsetid("", _OPSET)]
    content = onnx.helper.make_model(made, opset_imports=opset, ir_version=_IR, producer_name=MADE_BY)
    with written_whole(path) as file:
        file.write(content.SerializeToString())


def require_onnx(model: Model | None) -> Any:
    """Return the module onnx, if it is installed and a model can be written."""
    onnx = require_extra("onnx", "fit", "ONNX files")
    while isinstance(model, Corrected):
        model = model.model
    if model is not None and not isinstance(model, Linear | FeedforwardReLU | GaussianProcessModel):
        raise InputError(
            f"only linear models, networks, Gaussian processes and corrections of these can be written as ONNX, got "
            f"{model!r}."
        )
    return onnx


def _model(graph: _Graph, model: Model, output: str) -> tuple[int, int]:
    """Add the nodes of a model from ``z`` to an output; return the numbers of states and inputs."""
    if isinstance(model, Linear):
        n, m = model.B.shape
        graph.affine("z", np.concatenate([model.A, model.B], axis=1).T, model.c, output)
        return n, m
    if isinstance(model, Corrected):
        n, m = _model(graph, model.model, "before")
        _correction(graph, model.correction, "correction")
        graph.node("Add", ["before", "correction"], output)
        return n, m
    assert isinstance(model, FeedforwardReLU | GaussianProcessModel)  # require_onnx has checked it
    scaling = model.scaling
    n, width = len(scaling.shift_out), len(scaling.shift_in)
    graph.affine("z", np.diag(1 / scaling.scale_in), -scaling.shift_in / scaling.scale_in, "h0")
    if isinstance(model, FeedforwardReLU):
        last = len(model.weights) - 1
        for i, (weight, bias) in enumerate(zip(model.weights, model.biases, strict=True)):
            graph.affine(f"h{i}", weight, bias, f"a{i}")
            if i < last:
                graph.node("Relu", [f"a{i}"], f"h{i + 1}")
        graph.affine(f"a{last}", np.diag(scaling.scale_out), scaling.shift_out, "change")
    else:
        _squared_distance(graph, "h0", model.centres, model.covariance.length_scales, 0.5, "half")
        graph.node("Neg", ["half"], "exponent")
        graph.node("Exp", ["exponent"], "covariances")
        weights = model.covariance.variance * model.weights * scaling.scale_out
        graph.affine("covariances", weights, scaling.shift_out, "change")
    graph.affine("z", np.eye(width)[:, :n], np.zeros(n), "x")
    graph.node("Add", ["x", "change"], output)
    return n, width - n


def _correction(graph: _Graph, one: Correction, output: str) -> None:
    """Add ``clip(k(z) W + linear) * exp(-1/2 |beyond / fade|^2)``, as :class:`ctxval.models.Correction` computes it."""
    graph.affine("z", np.diag(1 / one.scale), -one.shift / one.scale, "pair")
    _squared_distance(graph, "pair", one.centres, one.length_scales, 5.0, "r2")
    graph.node("Sqrt", ["r2"], "r")
    graph.node("Neg", ["r"], "minus_r")
    graph.node("Exp", ["minus_r"], "decay")
    graph.with_constant("Mul", "r2", np.array([1 / 3]), "third")
    graph.node("Add", ["r", "third"], "polynomial")
    graph.with_constant("Add", "polynomial", np.array([1.0]), "polynomial_1")
    graph.node("Mul", ["polynomial_1", "decay"], "covariances")
    graph.affine("covariances", one.weights, np.zeros(one.states), "matern")
    graph.affine("pair", one.linear[:-1], one.linear[-1], "linear")
    graph.node("Add", ["matern", "linear"], "unlimited")
    graph.with_constant("Min", "unlimited", one.limit, "below")
    graph.with_constant("Max", "below", -one.limit, "limited")
    graph.with_constant("Min", "pair", one.high, "pair_below")
    graph.with_constant("Max", "pair_below", one.low, "inside")
    graph.node("Sub", ["pair", "inside"], "beyond")
    _squared_distance(graph, "beyond", np.zeros((1, len(one.fade))), one.fade, 0.5, "far")
    graph.node("Neg", ["far"], "minus_far")
    graph.node("Exp", ["minus_far"], "faded")
    graph.node("Mul", ["limited", "faded"], output)


def _squared_distance(graph: _Graph, source: str, centres: Array, scales: Array, factor: float, output: str) -> None:
    """Add ``factor |(z - c) / l|^2`` for each centre c, which rounding must not make negative."""
    inverse = factor / scales**2
    graph.node("Mul", [source, source], f"{output}_squares")
    graph.affine(source, (-2 * inverse * centres).T, (inverse * centres**2).sum(axis=1), f"{output}_mixed")
    squares = np.repeat(inverse[:, None], len(centres), axis=1)
    graph.affine(f"{output}_squares", squares, np.zeros(len(centres)), f"{output}_own")
    graph.node("Add", [f"{output}_mixed", f"{output}_own"], f"{output}_sum")
    graph.node("Relu", [f"{output}_sum"], output)


class _Graph:
    """The nodes and constants of a graph."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.tensors: list[Any] = []

    def node(self, kind: str, inputs: list[str], output: str) -> None:
        self.nodes.append(self._onnx.helper.make_node(kind, inputs, [output]))

    def constant(self, name: str, array: Array) -> str:
        """Add a constant; return its name."""
        self.tensors.append(self._onnx.numpy_helper.from_array(np.asarray(array, dtype=np.float64), name))
        return name

    def with_constant(self, kind: str, source: str, array: Array, output: str) -> None:
        """Add a node of a value and a constant that is broadcast."""
        self.node(kind, [source, self.constant(f"{output}_constant", array)], output)

    def affine(self, source: str, weight: Array, bias: Array, output: str) -> None:
        """Add ``output = source @ weight + bias``."""
        names = [self.constant(f"{output}_weight", weight), self.constant(f"{output}_bias", bias)]
        self.node("Gemm", [source, *names], output)
