"""Certificates: statements about d* with their assumptions, and the verdicts that rest on them."""

from typing import TYPE_CHECKING, Any

from ctxval.certificates.anytime import AnytimeAudit, certify_anytime
from ctxval.certificates.automatic import Automatic
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.convergence import is_validated, rate
from ctxval.certificates.covering import (
    RESOLUTION,
    bare_corners,
    covering,
    farthest_task,
    most_contested,
)
from ctxval.certificates.draws import Audit, certify_audit
from ctxval.certificates.dynamics import Dynamics, certify_dynamics
from ctxval.certificates.dynamics_evidence import (
    CheckedPrediction,
    DynamicsEvidence,
    LearnedDistance,
    StateInputCoverage,
    StateInputGap,
    UntriedParameter,
)
from ctxval.certificates.forecast import Forecast, forecast
from ctxval.certificates.maxima import Maxima, draw_maxima, settle_maxima
from ctxval.certificates.mean import Mean, certify_mean
from ctxval.certificates.options import CertificateOptions
from ctxval.certificates.posterior import Posterior, certify_posterior, instantaneous_bound
from ctxval.certificates.posterior_diagnostics import Diagnosis, diagnose
from ctxval.certificates.provenance import Provenance
from ctxval.certificates.region import Region, certify_region
from ctxval.certificates.registry import KINDS, require_use
from ctxval.certificates.sample import PLANNED, MadeGood, Sample, require_learned
from ctxval.certificates.scenario import (
    SamplingDiscarding,
    Scenario,
    certify_scenario,
    samples_needed,
    tail,
    volume_bound,
)
from ctxval.certificates.stopping import StoppingDecision, StoppingRule
from ctxval.certificates.verdict import Assessment, Verdict, assess, judge, judge_by

if TYPE_CHECKING:
    USES: dict[str, tuple[str, ...]]
    """For each option of certificates, the kinds that use it."""

__all__ = [
    "KINDS",
    "PLANNED",
    "RESOLUTION",
    "USES",
    "AnytimeAudit",
    "Assessment",
    "Audit",
    "Automatic",
    "Certificate",
    "CertificateKind",
    "CertificateOptions",
    "CheckedPrediction",
    "Diagnosis",
    "Dynamics",
    "DynamicsEvidence",
    "Forecast",
    "LearnedDistance",
    "MadeGood",
    "Maxima",
    "Mean",
    "Posterior",
    "Provenance",
    "Region",
    "Sample",
    "SamplingDiscarding",
    "Scenario",
    "StateInputCoverage",
    "StateInputGap",
    "StoppingDecision",
    "StoppingRule",
    "UntriedParameter",
    "Verdict",
    "assess",
    "bare_corners",
    "certify_anytime",
    "certify_audit",
    "certify_dynamics",
    "certify_mean",
    "certify_posterior",
    "certify_region",
    "certify_scenario",
    "covering",
    "diagnose",
    "draw_maxima",
    "farthest_task",
    "forecast",
    "instantaneous_bound",
    "is_validated",
    "judge",
    "judge_by",
    "most_contested",
    "rate",
    "require_learned",
    "require_use",
    "samples_needed",
    "settle_maxima",
    "tail",
    "volume_bound",
]

KINDS.collect()


def __getattr__(name: str) -> Any:
    """Return ``USES``: for each option, the kinds that use it. It is computed on request, as it imports all kinds."""
    if name != "USES":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    options = [option for name in KINDS.imported for option in KINDS.find(name).options()]
    return {option: KINDS.with_option(option) for option in options}
