"""Models that are learned from recordings."""

from __future__ import annotations

from ctxval.studies.fitting.excitation import Excitation, Excited, excitation
from ctxval.studies.fitting.fit import FailedFit, FitReport, FittedModel, fit
from ctxval.studies.fitting.least_squares import FittedParameter, fit_parameters

__all__ = [
    "Excitation",
    "Excited",
    "FailedFit",
    "FitReport",
    "FittedModel",
    "FittedParameter",
    "excitation",
    "fit",
    "fit_parameters",
]
