"""Graphs of operations on rows of numbers, in double precision, that are written as ONNX files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.extras import require_extra
from ctxval._util.files import MADE_BY, make_folder_of, written_whole


def require_onnx() -> Any:
    """Return the module onnx, if it is installed."""
    return require_extra("onnx", "fit", "ONNX files")


@dataclass(frozen=True, eq=False)
class GraphValue:
    """A value in a graph, with the operations that add a node to it; all values share the nodes and the constants."""

    name: str
    onnx: Any
    nodes: list[Any]
    tensors: list[Any]

    @classmethod
    def first(cls, name: str) -> Self:
        """Return the input of a new graph, rows of numbers."""
        return cls(name, require_onnx(), [], [])

    def node(self, kind: str, *others: Self | Array, output: int = 0, **attributes: Any) -> Self:
        """Return a result of an operation on this value and others; constants are broadcast.

        Args:
            output: which of its results this is.
            attributes: those of the operation.
        """
        names = [(each if isinstance(each, GraphValue) else self.constant(each)).name for each in (self, *others)]
        results = [f"value_{len(self.nodes)}_{k}" for k in range(output + 1)]
        self.nodes.append(self.onnx.helper.make_node(kind, names, results, **attributes))
        return replace(self, name=results[-1])

    def constant(self, values: Array) -> Self:
        """Return a constant of this graph."""
        name = f"constant_{len(self.tensors)}"
        self.tensors.append(self.onnx.numpy_helper.from_array(np.asarray(values), name))
        return replace(self, name=name)

    def affine(self, weight: Array, bias: Array) -> Self:
        return self.node("Gemm", weight, bias)

    def squared_distances(self, centres: Array, scales: Array, factor: float = 1.0) -> Self:
        """Return ``factor |(z - c) / l|^2`` for each centre c, which rounding must not make negative."""
        inverse = factor / scales**2
        mixed = self.affine((-2 * inverse * centres).T, (inverse * centres**2).sum(axis=1))
        squares = (self * self).affine(np.repeat(inverse[:, None], len(centres), axis=1), np.zeros(len(centres)))
        return (mixed + squares).node("Relu")

    def write(self, path: str | Path, title: str, width: int, outputs: dict[str, tuple[Self, str, list[Any]]]) -> Path:
        """Write the graph whose input this is, rows of so many numbers, to an ONNX file.

        Args:
            title: the name of the graph.
            width: the number of numbers in a row.
            outputs: values by name, with their type (``DOUBLE`` or ``BOOL``) and shape, in which ``"N"`` is the number
                of rows.
        """
        helper, kinds, ends = self.onnx.helper, self.onnx.TensorProto, []
        for name, (value, kind, shape) in outputs.items():
            self.nodes.append(helper.make_node("Identity", [value.name], [name]))
            ends.append(helper.make_tensor_value_info(name, getattr(kinds, kind), shape))
        given = helper.make_tensor_value_info(self.name, kinds.DOUBLE, ["N", width])
        graph = helper.make_graph(self.nodes, title, [given], ends, self.tensors)
        # Versions that onnxruntime has read since 2022.
        opset = [helper.make_opsetid("", 17)]
        content = helper.make_model(graph, opset_imports=opset, ir_version=8, producer_name=MADE_BY)
        make_folder_of(path)
        with written_whole(path) as file:
            file.write(content.SerializeToString())
        return Path(path)

    def __add__(self, other: Self | Array) -> Self:
        return self.node("Add", other)

    def __mul__(self, other: Self | Array) -> Self:
        return self.node("Mul", other)
