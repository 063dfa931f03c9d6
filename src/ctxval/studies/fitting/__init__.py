"""Models that are learned from recordings."""

from ctxval.studies.fitting.fit import FailedFit, FitReport, FittedModel, FittedParameter, fit, fit_parameters

__all__ = [
    "FailedFit",
    "FitReport",
    "FittedModel",
    "FittedParameter",
    "fit",
    "fit_parameters",
]
