"""An envelope as an ONNX file: the function ``trusted(task) -> bool, bound`` for planners in other languages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctxval._util.onnx_network import GraphValue
from ctxval.certificates.envelope_surface import Surfaces
from ctxval.core.space import TaskSpace


def write_onnx(path: str | Path, surfaces: Surfaces, space: TaskSpace, threshold: float) -> Path:
    """Write a graph with the input ``task`` ``(N, d)`` and the outputs ``trusted`` ``(N,)`` and ``bound`` ``(N,)``.

    It computes what :func:`ctxval.certificates.envelope_surface.upper_at` does, except for rounding.

    Raises:
        InputError: if onnx is not installed.
    """
    task, d = GraphValue.first("task"), space.dimension
    width = space.high - space.low
    unit = task.affine(np.diag(1 / width), -space.low / width)
    outermost = unit.node("Sub", np.array(0.5)).node("Abs").node("ReduceMax", axes=[1], keepdims=0)
    inside = outermost.node("LessOrEqual", np.array(0.5 + 1e-9))

    limited = unit.node("Min", np.array(1.0)).node("Max", np.array(0.0))
    squares = limited.squared_distances(surfaces.centres, np.ones(d))
    K, c = surfaces.errors.shape
    smooth = (squares * squares.node("Sqrt")).affine(surfaces.weights[:K], surfaces.weights[K])
    smooth += limited.affine(surfaces.weights[K + 1 :], np.zeros(c))
    nearest = squares.node("TopK", np.array([min(2 * (d + 1), K)]), output=1, axis=1, largest=0)
    errors = nearest.constant(surfaces.errors).node("Gather", nearest, axis=0)
    upper = smooth + errors.node("ReduceMax", axes=[1], keepdims=0)

    below = upper.node("ReduceMax", axes=[1], keepdims=0).node("LessOrEqual", np.array(1.0))
    trusted = inside.node("And", below)
    first = upper.affine(threshold * np.eye(c)[:, :1], np.zeros(1)).node("ReduceMax", axes=[1], keepdims=0)
    bound = trusted.node("Where", first.node("Max", np.array(0.0)), np.array(np.inf))
    return task.write(path, "envelope", d, {"trusted": (trusted, "BOOL", ["N"]), "bound": (bound, "DOUBLE", ["N"])})
