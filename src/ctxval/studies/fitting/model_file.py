"""A learned model as a file, in the format that the suffix of the file names.

An ONNX file has double precision, for robots and other programs; it needs onnx (extra ``fit``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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


_NO_REFERENCE = "the parameters of a function can only be written with the reference module:attr to it (--step)."


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
    if issubclass(makes, Parametric) and step is None:
        raise InputError(_NO_REFERENCE)
    if path.suffix == ".onnx":
        _require_onnx(before_refinement(model) if issubclass(makes, Corrected) else None)


def write_model_file(path: Path, model: Model, step: str | None = None) -> list[str]:
    """Write a model to a file, and the data of an ONNX file to another one; return their paths."""
    require_suffix(path)
    if not isinstance(model, SUFFIXES[path.suffix]):
        raise InputError(f"the model {model!r} cannot be written to a file that ends in {path.suffix}.")
    if isinstance(model, Parametric):
        if step is None:
            raise InputError(_NO_REFERENCE)
        values = ", ".join(f"{name} = {value!r}" for name, value in model.theta.items())
        dt = model.dt or getattr(model.data, "dt", None)
        lines = [
            f"# {MADE_BY}",
            "[model]",
            'type = "Parametric"',
            f'step = {{ ref = "{step}" }}',
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


def write_onnx(path: str | Path, model: Model) -> None:
    """Write a model as an ONNX file with one input ``(x, u)`` and the output ``x_next``."""
    onnx = _require_onnx(model)
    nodes, tensors = list[Any](), list[Any]()
    _, n, m = _next_state(_Value("z", onnx, nodes, tensors), model)
    nodes[-1].output[0] = "x_next"
    value, kind = onnx.helper.make_tensor_value_info, onnx.TensorProto.DOUBLE
    ends = [value("z", kind, ["N", n + m])], [value("x_next", kind, ["N", n])]
    made = onnx.helper.make_graph(nodes, "step", *ends, tensors)
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


def _next_state(z: _Value, model: Model) -> tuple[_Value, int, int]:
    """Return the next state of a model at ``z = (x, u)``, and the numbers of states and inputs."""
    if isinstance(model, Linear):
        n, m = model.B.shape
        return z.affine(np.concatenate([model.A, model.B], axis=1).T, model.c), n, m
    if isinstance(model, Corrected):
        before, n, m = _next_state(z, model.model)
        return before + _correction(z, model.correction), n, m
    assert isinstance(model, FeedforwardReLU | GaussianProcessModel)  # _require_onnx has checked it
    scaling = model.scaling
    n, width = len(scaling.shift_out), len(scaling.shift_in)
    h = z.affine(np.diag(1 / scaling.scale_in), -scaling.shift_in / scaling.scale_in)
    if isinstance(model, FeedforwardReLU):
        layers = list(zip(model.weights, model.biases, strict=True))
        for weight, bias in layers[:-1]:
            h = h.affine(weight, bias).node("Relu")
        change = h.affine(*layers[-1]).affine(np.diag(scaling.scale_out), scaling.shift_out)
    else:
        half = _squared_distance(h, model.centres, model.covariance.length_scales, 0.5)
        weights = model.covariance.variance * model.weights * scaling.scale_out
        change = half.node("Neg").node("Exp").affine(weights, scaling.shift_out)
    return z.affine(np.eye(width)[:, :n], np.zeros(n)) + change, n, width - n


def _correction(z: _Value, given: Correction) -> _Value:
    """Return ``clip(k(z) W + linear) * exp(-1/2 |beyond / fade|^2)``, as :class:`ctxval.models.Correction` does."""
    pair = z.affine(np.diag(1 / given.scale), -given.shift / given.scale)
    r2 = _squared_distance(pair, given.centres, given.length_scales, 5.0)
    r = r2.node("Sqrt")
    covariances = (r + r2 * np.array([1 / 3]) + np.array([1.0])) * r.node("Neg").node("Exp")
    unlimited = covariances.affine(given.weights, np.zeros(given.states)) + pair.affine(
        given.linear[:-1], given.linear[-1]
    )
    limited = unlimited.node("Min", given.limit).node("Max", -given.limit)
    beyond = pair.node("Sub", pair.node("Min", given.high).node("Max", given.low))
    far = _squared_distance(beyond, np.zeros((1, len(given.fade))), given.fade, 0.5)
    return limited * far.node("Neg").node("Exp")


def _squared_distance(z: _Value, centres: Array, scales: Array, factor: float) -> _Value:
    """Return ``factor |(z - c) / l|^2`` for each centre c, which rounding must not make negative."""
    inverse = factor / scales**2
    mixed = z.affine((-2 * inverse * centres).T, (inverse * centres**2).sum(axis=1))
    squares = (z * z).affine(np.repeat(inverse[:, None], len(centres), axis=1), np.zeros(len(centres)))
    return (mixed + squares).node("Relu")


@dataclass(frozen=True, eq=False)
class _Value:
    """A value in a graph, with the operations that add a node to it; all values share the nodes and the constants."""

    name: str
    onnx: Any
    nodes: list[Any]
    tensors: list[Any]

    def node(self, kind: str, *others: _Value | Array) -> _Value:
        """Return the result of an operation on this value and others; constants are broadcast."""
        names = [self.name]
        for other in others:
            if not isinstance(other, _Value):
                array, name = np.asarray(other, dtype=np.float64), f"constant_{len(self.tensors)}"
                self.tensors.append(self.onnx.numpy_helper.from_array(array, name))
            names.append(other.name if isinstance(other, _Value) else self.tensors[-1].name)
        result = f"value_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, names, [result]))
        return replace(self, name=result)

    def affine(self, weight: Array, bias: Array) -> _Value:
        return self.node("Gemm", weight, bias)

    def __add__(self, other: _Value | Array) -> _Value:
        return self.node("Add", other)

    def __mul__(self, other: _Value | Array) -> _Value:
        return self.node("Mul", other)
