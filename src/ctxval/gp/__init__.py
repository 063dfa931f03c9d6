"""Gaussian processes: kernels, regression, draws of hyperparameters and sample paths, acquisition functions.

This package is independent of control: points are rows of numbers, often in the unit cube, and values are numbers.
"""

from __future__ import annotations

from ctxval.gp.acquisition import (
    Acquisition,
    LogExpectedImprovement,
    Uncertainty,
    UpperConfidenceBound,
    maximise,
)
from ctxval.gp.ascent import Ascent
from ctxval.gp.cholesky import CholeskyFactor, factorise
from ctxval.gp.global_search import GlobalMaximum, search_globally
from ctxval.gp.hyperposterior import Conditioned, Hyperparameters, Prior, draw_hyperparameters
from ctxval.gp.kernels import Kernel, Linear, Matern, Sum
from ctxval.gp.regression import GaussianProcess, MultiOutputProcess, condition, fit
from ctxval.gp.sample_paths import Paths, draw_paths, maxima
from ctxval.gp.subset import kept_rows, pivoted_rows
from ctxval.gp.surrogate import Surrogate, fit_surrogate

__all__ = [
    "Acquisition",
    "Ascent",
    "CholeskyFactor",
    "Conditioned",
    "GaussianProcess",
    "GlobalMaximum",
    "Hyperparameters",
    "Kernel",
    "Linear",
    "LogExpectedImprovement",
    "Matern",
    "MultiOutputProcess",
    "Paths",
    "Prior",
    "Sum",
    "Surrogate",
    "Uncertainty",
    "UpperConfidenceBound",
    "condition",
    "draw_hyperparameters",
    "draw_paths",
    "factorise",
    "fit",
    "fit_surrogate",
    "kept_rows",
    "maxima",
    "maximise",
    "pivoted_rows",
    "search_globally",
]
