"""A learned model as a file, in the format that the suffix of the file names.

An ONNX file has double precision, for robots and other programs; it needs onnx (extra ``fit``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import MADE_BY, make_folder_of, write_text, written_whole
from ctxval._util.refusals import require_extra
from ctxval._util.toml import toml_text
from ctxval.core.labels import units_of
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.models import Corrected, Correction, FeedforwardReLU, GaussianProcessModel, Linear, Parametric
from ctxval.models.corrected import before_refinement
from ctxval.models.saved import names_as_text, write_model, write_transitions

_ARRAYS = (Linear, FeedforwardReLU, GaussianProcessModel, Corrected)
#: the models that a file of each suffix can hold
SUFFIXES: dict[str, tuple[type, ...]] = {".npz": _ARRAYS, ".onnx": _ARRAYS, ".toml": (Parametric,)}
BESIDE = (".data.npz", ".residual.json", ".residual.txt")  #: the suffixes of files that may be written beside a model
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
        theta = {name: float(value) for name, value in model.theta.items()}
        table: dict[str, Any] = {"type": "Parametric", "step": {"ref": step}, "theta": theta}
        if (dt := model.dt or getattr(model.data, "dt", None)) is not None:
            table["dt"] = float(dt)
        if model.vectorized:
            table["vectorized"] = True
        named = zip(("states", "inputs"), units_of(model), strict=True)
        table |= {kind: dict(names) for kind, names in named if names}
        return [str(write_text(path, f"# {MADE_BY}\n{toml_text({'model': table})}"))]
    if path.suffix == ".npz":
        write_model(path, model)
        return [str(path)]
    write_onnx(path, model)
    data, beside = getattr(model, "data", None), path.with_suffix(".data.npz")
    if data is None:
        return [str(path)]
    write_transitions(beside, data)
    return [str(path), str(beside)]


def write_onnx(path: str | Path, model: Model) -> None:
    """Write a model as an ONNX file with one input ``(x, u)`` and the output ``x_next``."""
    _require_onnx(model)
    graph = _Graph()
    following, n, m = _next_state(graph, "z", model)
    helper, real = graph.onnx.helper, graph.onnx.TensorProto.DOUBLE
    nodes = [*graph.nodes, helper.make_node("Identity", [following], ["x_next"])]
    given, returned = (
        helper.make_tensor_value_info(*end) for end in (("z", real, ["N", n + m]), ("x_next", real, ["N", n]))
    )
    whole = helper.make_graph(nodes, "step", [given], [returned], graph.constants)
    # Versions that onnxruntime has read since 2022.
    opset = [helper.make_opsetid("", 17)]
    content = helper.make_model(whole, opset_imports=opset, ir_version=8, producer_name=MADE_BY)
    helper.set_model_props(content, {"ctxval": names_as_text(model)})
    make_folder_of(path)
    with written_whole(path) as file:
        file.write(content.SerializeToString())


def require_onnx() -> Any:
    """Return the module onnx, if it is installed."""
    return require_extra("onnx", "fit", "ONNX files need")


def _require_onnx(model: Model | None) -> None:
    require_onnx()
    while isinstance(model, Corrected):
        model = model.model
    if model is not None and not isinstance(model, Linear | FeedforwardReLU | GaussianProcessModel):
        raise InputError(
            f"only linear models, networks, Gaussian processes and corrections of these can be written as ONNX, got "
            f"{model!r}."
        )


class _Graph:
    """Operations on named rows of numbers; arrays become constants, which are broadcast."""

    def __init__(self) -> None:
        self.onnx = require_onnx()
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def __call__(self, kind: str, *operands: str | Array) -> str:
        """Add an operation of ONNX, and return the name of its result."""
        names = [each if isinstance(each, str) else self._constant(each) for each in operands]
        result = f"value_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, names, [result]))
        return result

    def _constant(self, values: Array) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(values), name))
        return name

    def squared_distances(self, rows: str, centres: Array, scales: Array, factor: float = 1.0) -> str:
        """Return ``factor |(z - c) / l|^2`` for each centre c, which rounding must not make negative."""
        inverse = factor / scales**2
        mixed = self("Gemm", rows, (-2 * inverse * centres).T, (inverse * centres**2).sum(axis=1))
        of_rows = np.repeat(inverse[:, None], len(centres), axis=1), np.zeros(len(centres))
        return self("Relu", self("Add", mixed, self("Gemm", self("Mul", rows, rows), *of_rows)))


def _next_state(graph: _Graph, z: str, model: Any) -> tuple[str, int, int]:
    """Return the next state of a model at ``z = (x, u)``, and the numbers of states and inputs."""
    if isinstance(model, Corrected):
        before, n, m = _next_state(graph, z, model.model)
        return graph("Add", before, _correction(graph, z, model.correction)), n, m
    if isinstance(model, Linear):
        n, m = model.B.shape
        return graph("Gemm", z, np.concatenate([model.A, model.B], axis=1).T, model.c), n, m
    scaling = model.scaling
    n, width = len(scaling.shift_out), len(scaling.shift_in)
    h = graph("Gemm", z, np.diag(1 / scaling.scale_in), -scaling.shift_in / scaling.scale_in)
    if isinstance(model, FeedforwardReLU):
        *layers, last = zip(model.weights, model.biases, strict=True)
        for weight, bias in layers:
            h = graph("Relu", graph("Gemm", h, weight, bias))
        change = graph("Gemm", graph("Gemm", h, *last), np.diag(scaling.scale_out), scaling.shift_out)
    else:
        half = graph.squared_distances(h, model.centres, model.covariance.length_scales, 0.5)
        weights = model.covariance.variance * model.weights * scaling.scale_out
        change = graph("Gemm", graph("Exp", graph("Neg", half)), weights, scaling.shift_out)
    return graph("Add", graph("Gemm", z, np.eye(width)[:, :n], np.zeros(n)), change), n, width - n


def _correction(graph: _Graph, z: str, given: Correction) -> str:
    """Return ``clip(k(z) W + linear) * exp(-1/2 |beyond / fade|^2)``, as :class:`ctxval.models.Correction` does."""
    pair = graph("Gemm", z, np.diag(1 / given.scale), -given.shift / given.scale)
    r2 = graph.squared_distances(pair, given.centres, given.length_scales, 5.0)
    r = graph("Sqrt", r2)
    polynomial = graph("Add", graph("Add", r, graph("Mul", r2, np.array([1 / 3]))), np.array([1.0]))
    covariances = graph("Mul", polynomial, graph("Exp", graph("Neg", r)))
    kernels = graph("Gemm", covariances, given.weights, np.zeros(given.states))
    linear = graph("Gemm", pair, *np.split(given.linear, [-1]))
    limited = graph("Max", graph("Min", graph("Add", kernels, linear), given.limit), -given.limit)
    beyond = graph("Sub", pair, graph("Max", graph("Min", pair, given.high), given.low))
    far = graph.squared_distances(beyond, np.zeros((1, len(given.fade))), given.fade, 0.5)
    return graph("Mul", limited, graph("Exp", graph("Neg", far)))
