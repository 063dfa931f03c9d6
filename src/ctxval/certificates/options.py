"""What a user decides about a certificate before the trials are judged by it, in one value."""

from __future__ import annotations

from dataclasses import dataclass, field

from ctxval._util.representation import record
from ctxval.certificates.base import CertificateKind
from ctxval.certificates.bounds import require_probability
from ctxval.certificates.covering import RESOLUTION
from ctxval.certificates.posterior import Posterior
from ctxval.errors import CertificateError, InputError

CONFIDENCE = 0.95
"""Confidence of a verdict, unless another one is stated."""

LEAST_CONFIDENCE = 0.5
"""Below it a statement is wrong as often as right."""

MOST_VOLUME = 0.5
"""Above it a statement leaves out most of what it is about."""


@dataclass(frozen=True)
class CertificateOptions:
    """By which certificate trials are judged.

    Attributes:
        kind: the kind of certificate, with its own options.
        confidence: of the certificate, at least 0.5.
        volume: the share of the task space that may exceed the threshold; 0 accepts bounds on d* alone.

    Raises:
        CertificateError: the confidence is no probability.
        InputError: the confidence is below 0.5, or the volume negative or above 0.5.
    """

    kind: CertificateKind = field(default_factory=Posterior)
    confidence: float = CONFIDENCE
    volume: float = 0.0

    def __post_init__(self) -> None:
        require_confidence(self.confidence)
        require_volume(self.volume)

    @classmethod
    def posterior(
        cls, confidence: float = CONFIDENCE, *, stochastic: bool = False, resolution: float = RESOLUTION
    ) -> CertificateOptions:
        """Return the posterior bound with these options, as :class:`Posterior` has them."""
        return cls(Posterior(stochastic, resolution), confidence)

    def __repr__(self) -> str:
        return record(self)


def require_confidence(confidence: float) -> float:
    """Return the confidence of a verdict.

    Raises:
        CertificateError: it is no probability.
        InputError: it is below 0.5.
    """
    require_probability("the confidence", confidence)
    if 1 - confidence == 1:
        raise CertificateError(f"the confidence must be strictly between 0 and 1, got {confidence!r}.")
    if confidence < LEAST_CONFIDENCE:
        raise InputError(
            f"a verdict with confidence {confidence:g} would be wrong more often than right; state at least "
            f"{LEAST_CONFIDENCE:g}, and {CONFIDENCE:g} is usual."
        )
    return float(confidence)


def require_volume(volume: float) -> float:
    """Return the share of the task space that may exceed a threshold.

    Raises:
        InputError: it is negative, or above 0.5.
    """
    if not 0 <= volume <= MOST_VOLUME:
        raise InputError(
            f"the volume must be a share of the task space from 0 to {MOST_VOLUME:g}, got {volume!r}: more would leave "
            "out most of the tasks."
        )
    return float(volume)
