"""Learned models M: ready-made ones and adapters."""

from __future__ import annotations

from ctxval._util.registry import Registry
from ctxval.core.model import Function, Model, linearize
from ctxval.models.corrected import Corrected, Correction, Refined
from ctxval.models.foreign_networks import Onnx, Torch
from ctxval.models.increments import FeedforwardReLU, GaussianProcessModel, IncrementScaling, SquaredExponential
from ctxval.models.linear import Linear, state_space
from ctxval.models.mujoco import MuJoCo
from ctxval.models.parametric import Expected, Parametric
from ctxval.models.saved import read_model, read_refined, write_model, write_transitions
from ctxval.models.scikit_learn import ScikitLearn

__all__ = [
    "REGISTRY",
    "Corrected",
    "Correction",
    "Expected",
    "FeedforwardReLU",
    "Function",
    "GaussianProcessModel",
    "IncrementScaling",
    "Linear",
    "Model",
    "MuJoCo",
    "Onnx",
    "Parametric",
    "Refined",
    "ScikitLearn",
    "SquaredExponential",
    "Torch",
    "by_name",
    "linearize",
    "read_model",
    "read_refined",
    "state_space",
    "write_model",
    "write_transitions",
]

REGISTRY: Registry[Model] = Registry("model", __name__, method="step")
"""The models that are found by name: those of this package, and those that installed packages add."""

by_name = REGISTRY.make
