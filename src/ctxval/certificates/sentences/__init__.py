"""Every sentence about the numbers of certificates: ``statements``, ``verdicts``, and ``withdrawals`` of bounds."""

from ctxval.certificates.sentences.statements import dynamics_assumptions, envelope_statement

__all__ = ["dynamics_assumptions", "envelope_statement"]
