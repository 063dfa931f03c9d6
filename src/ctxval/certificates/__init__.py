"""Certificates: statements on d*, each with its assumptions."""

from ctxval.certificates.base import Certificate, Sample
from ctxval.certificates.convergence import certify_convergence, rate
from ctxval.certificates.scenario import certify_scenario, samples_needed, tail, volume_bound

__all__ = [
    "Certificate",
    "Sample",
    "certify_convergence",
    "certify_scenario",
    "rate",
    "samples_needed",
    "tail",
    "volume_bound",
]
