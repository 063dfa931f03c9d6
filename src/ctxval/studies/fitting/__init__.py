"""Models that are learned from recordings."""

from ctxval.studies.fitting.excitation import Excitation, Excited, ExcitedWithMemory, excitation
from ctxval.studies.fitting.fit import FailedFit, FitReport, FittedModel, FittedParameter, fit, fit_parameters

__all__ = [
    "Excitation",
    "Excited",
    "ExcitedWithMemory",
    "FailedFit",
    "FitReport",
    "FittedModel",
    "FittedParameter",
    "excitation",
    "fit",
    "fit_parameters",
]
