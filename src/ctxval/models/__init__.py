"""Learned models M: ready-made ones and adapters."""

from ctxval.core.model import Function, Model, linearize
from ctxval.models.gaussian_process import GaussianProcessModel, SquaredExponential
from ctxval.models.linear import Linear
from ctxval.models.neural_network import FeedforwardReLU
from ctxval.models.onnx import Onnx
from ctxval.models.scaling import IncrementScaling
from ctxval.models.scikit_learn import ScikitLearn
from ctxval.models.state_space import state_space

__all__ = [
    "FeedforwardReLU",
    "Function",
    "GaussianProcessModel",
    "IncrementScaling",
    "Linear",
    "Model",
    "Onnx",
    "ScikitLearn",
    "SquaredExponential",
    "linearize",
    "state_space",
]
