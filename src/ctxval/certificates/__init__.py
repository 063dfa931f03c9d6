"""Certificates: statements on d*, each with its assumptions."""

from ctxval.certificates.base import PLANNED, Certificate, MadeGood, Sample
from ctxval.certificates.convergence import TheoremConstants, certify_convergence, rate
from ctxval.certificates.covering import (
    RESOLUTION,
    bare_corners,
    covering,
    farthest_task,
    most_contested,
    require_resolution,
)
from ctxval.certificates.diagnostics import Diagnosis, diagnose
from ctxval.certificates.forecast import Forecast, forecast
from ctxval.certificates.named import KINDS, USES, Options, certify, require_possible, require_use
from ctxval.certificates.posterior import Maxima, certify_posterior, draw_maxima, instantaneous_bound, settle_maxima
from ctxval.certificates.scenario import certify_audit, certify_scenario, samples_needed, tail, volume_bound

__all__ = [
    "KINDS",
    "PLANNED",
    "RESOLUTION",
    "USES",
    "Certificate",
    "Diagnosis",
    "Forecast",
    "MadeGood",
    "Maxima",
    "Options",
    "Sample",
    "TheoremConstants",
    "bare_corners",
    "certify",
    "certify_audit",
    "certify_convergence",
    "certify_posterior",
    "certify_scenario",
    "covering",
    "diagnose",
    "draw_maxima",
    "farthest_task",
    "forecast",
    "instantaneous_bound",
    "most_contested",
    "rate",
    "require_possible",
    "require_resolution",
    "require_use",
    "samples_needed",
    "settle_maxima",
    "tail",
    "volume_bound",
]
