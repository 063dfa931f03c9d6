"""A learned model as a file, in the format that the suffix of the file names.

An ONNX file has double precision, for robots and other programs; it needs onnx (extra ``fit``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.extras import require_extra
from ctxval._util.files import MADE_BY, write_text, written_whole
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.models import Corrected, Correction, FeedforwardReLU, GaussianProcessModel, Linear, Parametric
from ctxval.models.corrected import before_refinement
from ctxval.models.saved import write_model, write_transitions

SUFFIXES: dict[str, tuple[type, ...]] = {
    ".npz": (Linear, FeedforwardReLU, GaussianProcessModel, Corrected),
    ".onnx": (Linear, FeedforwardReLU, GaussianProcessModel, Corrected),
    ".toml": (Parametric,),
}
"""The models that a file of each suffix can hold."""

BESIDE = (".data.npz", ".residual.json", ".residual.txt")
"""The suffixes of the files that may be written beside a model."""


def require_suffix(path: Path) -> None:
    """Check that the name of the file of a model ends as one that can be written."""
    if path.suffix not in SUFFIXES:
        raise InputError(f"the file of a model must end in {', '.join(SUFFIXES)}, got {str(path)!r}.")


def require_file_of(path: Path, method: str, makes: type[Model] | None, model: Model, step: str | None = None) -> None:
    """Check that a file can hold the model that a method learns in place of another one, before executions are paid."""
    require_suffix(path)
    if makes is None:  # a user's function may return any model, which is checked when it is written
        return
    suitable = [suffix for suffix, models in SUFFIXES.items() if issubclass(makes, models)]
    if path.suffix not in suitable:
        raise InputError(
            f"the model of the method {method!r} cannot be written to a file that ends in {path.suffix}: give one that "
            f"ends in {' or '.join(suitable)}."
        )
    if issubclass(makes, Parametric):
        _require_reference(step)
    if path.suffix == ".onnx":
        _require_onnx(before_refinement(model) if issubclass(makes, Corrected) else None)


def write_model_file(path: Path, model: Model, step: str | None = None) -> list[str]:
    """Write a model to a file, and the data of an ONNX file to another one; return their paths."""
    require_suffix(path)
    if not isinstance(model, SUFFIXES[path.suffix]):
        raise InputError(f"the model {model!r} cannot be written to a file that ends in {path.suffix}.")
    if isinstance(model, Parametric):
        values = ", ".join(f"{name} = {value!r}" for name, value in model.theta.items())
        dt = model.dt or getattr(model.data, "dt", None)
        lines = [
            f"# {MADE_BY}",
            "[model]",
            'type = "Parametric"',
            f'step = {{ ref = "{_require_reference(step)}" }}',
            f"theta = {{ {values} }}",
            *([] if dt is None else [f"dt = {dt!r}"]),
            *(["vectorized = true"] if model.vectorized else []),
        ]
        return [str(write_text(path, "\n".join([*lines, ""])))]
    if path.suffix == ".npz":
        write_model(path, model)
        return [str(path)]
    write_onnx(path, model)
    data = getattr(model, "data", None)
    if data is None:
        return [str(path)]
    beside = path.with_suffix(".data.npz")
    write_transitions(beside, data)
    return [str(path), str(beside)]


def _require_reference(step: str | None) -> str:
    """Return the reference ``module:attr`` to the user's function, without which its parameters cannot be written."""
    if step is None:
        raise InputError(
            "the parameters of a function can only be written with the reference module:attr to it (--step)."
        )
    return step


def write_onnx(path: str | Path, model: Model) -> None:
    """Write a model as an ONNX file with one input ``(x, u)`` and the output ``x_next``."""
    onnx = _require_onnx(model)
    graph = _Graph(onnx)
    n, m = _model(graph, model, "x_next")
    value = onnx.helper.make_tensor_value_info
    kind = onnx.TensorProto.DOUBLE
    made = onnx.helper.make_graph(
        graph.nodes, "step", [value("z", kind, ["N", n + m])], [value("x_next", kind, ["N", n])], graph.tensors
    )
    # Versions that onnxruntime has read since 2022.
    opset = [onnx.helper.make_opsetid("", 17)]
    content = onnx.helper.make_model(made, opset_imports=opset, ir_version=8, producer_name=MADE_BY)
    with written_whole(path) as file:
        file.write(content.SerializeToString())


def _require_onnx(model: Model | None) -> Any:
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
