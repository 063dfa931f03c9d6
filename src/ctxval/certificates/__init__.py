"""Certificates: statements about d* with their assumptions, and the verdicts that rest on them."""

from ctxval.certificates.anytime import AnytimeAudit
from ctxval.certificates.automatic import Automatic, WholeSuite
from ctxval.certificates.base import KINDS, Certificate, CertificateKind, require_use
from ctxval.certificates.covering import RESOLUTION, bare_corners, covering, farthest_task, most_contested
from ctxval.certificates.dynamics import Dynamics, certify_dynamics
from ctxval.certificates.evidence import Evidence, Learned
from ctxval.certificates.expiry import WatchState
from ctxval.certificates.forecast import Forecast
from ctxval.certificates.maxima import Maxima, draw_maxima, settle_maxima
from ctxval.certificates.options import CertificateOptions
from ctxval.certificates.posterior import Diagnosis, DistanceBound, diagnose, instantaneous_bound
from ctxval.certificates.predictions import CheckedPrediction
from ctxval.certificates.provenance import Neighbour, Provenance
from ctxval.certificates.sample import RecoveredFailure, Sample, require_learned
from ctxval.certificates.scenario import Audit, SamplingDiscarding, Scenario, samples_needed, tail, volume_bound
from ctxval.certificates.stopping import StoppingDecision, StoppingRule
from ctxval.certificates.verdict import Assessment, Verdict, assess, judge, judge_by
from ctxval.core.coverage import StateInputCoverage, StateInputGap, UnsampledCorner, UnsampledParameter

__all__ = [
    "KINDS",
    "RESOLUTION",
    "AnytimeAudit",
    "Assessment",
    "Audit",
    "Automatic",
    "Certificate",
    "CertificateKind",
    "CertificateOptions",
    "CheckedPrediction",
    "Diagnosis",
    "DistanceBound",
    "Dynamics",
    "Evidence",
    "Forecast",
    "Learned",
    "Maxima",
    "Neighbour",
    "Provenance",
    "RecoveredFailure",
    "Sample",
    "SamplingDiscarding",
    "Scenario",
    "StateInputCoverage",
    "StateInputGap",
    "StoppingDecision",
    "StoppingRule",
    "UnsampledCorner",
    "UnsampledParameter",
    "Verdict",
    "WatchState",
    "WholeSuite",
    "assess",
    "bare_corners",
    "certify_dynamics",
    "covering",
    "diagnose",
    "draw_maxima",
    "farthest_task",
    "instantaneous_bound",
    "judge",
    "judge_by",
    "most_contested",
    "require_learned",
    "require_use",
    "samples_needed",
    "settle_maxima",
    "tail",
    "volume_bound",
]
