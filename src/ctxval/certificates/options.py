"""Options of a verdict: the kind of certificate, its confidence and the acceptable volume."""

from __future__ import annotations

from dataclasses import dataclass, field

from ctxval._util.checked import Probability, checked
from ctxval._util.representation import ShortRepr
from ctxval.certificates.automatic import Automatic
from ctxval.certificates.base import CertificateKind
from ctxval.certificates.covering import RESOLUTION
from ctxval.certificates.posterior import Posterior
from ctxval.errors import InputError

CONFIDENCE = 0.95  # default of a verdict
WITHIN = 0.05  # default share by which the bound exceeds the largest distance where a search without a threshold ends
LEAST_CONFIDENCE = 0.5  # below it, a statement is wrong more often than right
MOST_VOLUME = 0.5  # above it, a statement leaves out most of the task space


@checked
@dataclass(frozen=True)
class CertificateOptions(ShortRepr):
    """The certificate by which trials are judged, and the volume that it may leave out."""

    kind: CertificateKind = field(default_factory=Automatic)  #: the kind of certificate, with its own options
    confidence: Probability = CONFIDENCE  #: confidence level of the certificate, at least 0.5
    #: the share of the task space that may exceed the threshold, at most 0.5; if it is 0, only bounds on d* validate
    volume: float = 0.0

    def __post_init__(self) -> None:
        require_confidence(self.confidence)
        require_volume(self.volume)

    @classmethod
    def posterior(cls, confidence: float = CONFIDENCE, *, resolution: float = RESOLUTION) -> CertificateOptions:
        """Return options with the posterior bound; the resolution is that of :class:`Posterior`."""
        return cls(Posterior(resolution), confidence)

    @classmethod
    def or_automatic(
        cls, certificate: CertificateOptions | None, confidence: float, resolution: float
    ) -> CertificateOptions:
        """Return a certificate that is given, beside which no options may stand; else ``auto`` with the options."""
        if certificate is None:
            return cls(Automatic(resolution), confidence)
        if (confidence, resolution) != (CONFIDENCE, RESOLUTION):
            raise InputError("confidence and resolution are options of certificate=; state them there.")
        return certificate


@checked
def require_confidence(confidence: Probability) -> float:
    """Return the confidence of a verdict."""
    if confidence < LEAST_CONFIDENCE:
        raise InputError(
            f"a verdict with confidence {confidence:g} would be wrong more often than right; state at least "
            f"{LEAST_CONFIDENCE:g}, and {CONFIDENCE:g} is usual."
        )
    return float(confidence)


def require_volume(volume: float) -> float:
    """Return the share of the task space that may exceed a threshold."""
    if not 0 <= volume <= MOST_VOLUME:
        raise InputError(
            f"the volume must be a share of the task space from 0 to {MOST_VOLUME:g}, got {volume!r}: more would leave "
            "out most of the tasks."
        )
    return float(volume)
