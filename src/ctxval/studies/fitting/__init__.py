"""Models that are learned from recordings."""

from ctxval.studies.fitting.excitation import Excitation, Excited, excitation
from ctxval.studies.fitting.fit import FailedFit, FitReport, FittedModel, FittedParameter, fit, fit_parameters

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
