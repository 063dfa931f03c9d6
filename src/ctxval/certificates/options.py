"""Options of a verdict: the kind of certificate, its confidence and the acceptable volume."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from ctxval._util.checked import Must, checked
from ctxval._util.representation import ShortRepr
from ctxval.certificates.automatic import Automatic
from ctxval.certificates.base import CertificateKind
from ctxval.certificates.covering import RESOLUTION
from ctxval.errors import InputError

CONFIDENCE = 0.95  # default of a verdict
WITHIN = 0.05  # default share by which the bound exceeds the largest distance where a search without a threshold ends
LEAST_CONFIDENCE = 0.5
MOST_VOLUME = 0.5

_NO_LESS = "with less, a verdict would be wrong more often than right"
_PROBABILITY = f"from {LEAST_CONFIDENCE:g} to below 1 ({_NO_LESS}; {CONFIDENCE:g} is usual)"
_SHARE = f"a share of the task space from 0 to {MOST_VOLUME:g} (more would leave out most of the tasks)"
Confidence = Annotated[float, Must(_PROBABILITY, lambda value: LEAST_CONFIDENCE <= value < 1)]
Volume = Annotated[float, Must(_SHARE, lambda value: 0 <= value <= MOST_VOLUME)]


@checked
@dataclass(frozen=True)
class CertificateOptions(ShortRepr):
    """The certificate by which trials are judged, and the volume that it may leave out."""

    kind: CertificateKind = field(default_factory=Automatic)  #: the kind of certificate, with its own options
    confidence: Confidence = CONFIDENCE  #: confidence level of the certificate, at least 0.5
    volume: Volume = 0.0  #: share of the tasks that may exceed the threshold; if it is 0, only bounds on d* validate

    @property
    def left_out(self) -> float:
        """The share of the tasks that may exceed the threshold, by the volume or by the share of its kind."""
        return max(self.volume, self.kind.target.volume)

    @classmethod
    def or_automatic(
        cls, certificate: CertificateOptions | None, confidence: float, resolution: float, share: float = 1.0
    ) -> CertificateOptions:
        """Return a certificate that is given, beside which no options may stand; else ``auto`` with the options.

        Raises:
            InputError: if options stand beside a certificate.
        """
        if certificate is None:
            return cls(Automatic(resolution, share=share), confidence)
        if (confidence, resolution, share) != (CONFIDENCE, RESOLUTION, 1.0):
            raise InputError("confidence, resolution and share are options of certificate=; state them there.")
        return certificate
