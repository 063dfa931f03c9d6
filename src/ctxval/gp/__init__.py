"""Gaussian processes: kernels, regression, draws of hyperparameters and sample paths, acquisition functions.

This package is independent of control: points are rows of numbers, often in the unit cube, and values are numbers.
"""

from __future__ import annotations

from ctxval.gp.kernels import Matern
from ctxval.gp.regression import GaussianProcess
from ctxval.gp.surrogate import Surrogate

__all__ = ["GaussianProcess", "Matern", "Surrogate"]
