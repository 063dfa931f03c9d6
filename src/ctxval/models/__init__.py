"""Learned models M: ready-made ones and adapters."""

from __future__ import annotations

from typing import Any

from ctxval._util.registry import Registry
from ctxval.core.model import Function, Model, linearize
from ctxval.models.gaussian_process import GaussianProcessModel, SquaredExponential
from ctxval.models.linear import Linear
from ctxval.models.neural_network import FeedforwardReLU
from ctxval.models.onnx import Onnx
from ctxval.models.scaling import IncrementScaling
from ctxval.models.scikit_learn import ScikitLearn
from ctxval.models.state_space import state_space

__all__ = [
    "REGISTRY",
    "FeedforwardReLU",
    "Function",
    "GaussianProcessModel",
    "IncrementScaling",
    "Linear",
    "Model",
    "Onnx",
    "ScikitLearn",
    "SquaredExponential",
    "by_name",
    "linearize",
    "state_space",
]

REGISTRY = Registry("model", __name__, method="step")
"""The models that are found by name: those of this package, and those that installed packages add."""


def by_name(name: str, /, **arguments: Any) -> Model:
    """Return a new model from its name and its arguments.

    Args:
        name: of :data:`REGISTRY`, such as ``"Linear"``.
        arguments: those of its class.

    Raises:
        UnknownNameError: there is no such model, or it takes no such argument; the message has the nearest name.
        InputError: the model refuses these arguments.
    """
    made: Model = REGISTRY.make(name, **arguments)
    return made
