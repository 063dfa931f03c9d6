"""Learned models M: ready-made ones and adapters."""

from ctxval.model import Function, Model, linearize
from ctxval.models.linear import Linear

__all__ = ["Function", "Linear", "Model", "linearize"]
