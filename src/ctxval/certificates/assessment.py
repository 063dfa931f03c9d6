"""The result of ``ctxval certify``: a certificate of the trials and, if there is a threshold, a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ctxval._util.representation import ShortRepr
from ctxval.certificates.base import Certificate
from ctxval.certificates.options import CertificateOptions
from ctxval.certificates.provenance import Provenance
from ctxval.certificates.verdict import Verdict, counterexample, judge, judge_by
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError


@dataclass(frozen=True, eq=False)
class Assessment(ShortRepr):
    """A certificate and a verdict of the same trials.

    Attributes:
        kind: the name of the certificate's kind.
        certificate: the certificate; None if its theory refuses the trials.
        verdict: the verdict; None if no threshold was given.
        refusal: why there is no certificate; None if there is one.
    """

    kind: str
    certificate: Certificate | None
    verdict: Verdict | None = None
    refusal: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the certificate, the verdict and the forecast as one flat table, ready for JSON."""
        said = {} if self.verdict is None else self.verdict.to_json()
        expected = None if self.verdict is None or self.verdict.expected is None else asdict(self.verdict.expected)
        refused = {"kind": self.kind, "refused": self.refusal}
        proved = refused if self.certificate is None else self.certificate.to_json()
        return {**said, **proved, "expected": expected}


def assess(
    trials: Sequence[Trial],
    options: CertificateOptions,
    threshold: float | None = None,
    provenance: Provenance | None = None,
) -> Assessment:
    """Return a certificate of the trials and, if there is a threshold, a verdict.

    A trial whose distance exceeds the threshold falsifies it without a certificate. The certificate is computed all
    the same, if its theory allows the trials.

    Args:
        trials: all trials of the campaign.
        options: the kind of certificate, its confidence and the acceptable volume.
        threshold: tau, in the distance's units; if it is None, there is no verdict.
        provenance: the task space, the search and remarks on the campaign, as far as they are known.

    Raises:
        CertificateError: if the certificate's theory refuses the trials and none of them exceeds the threshold.
        InputError: if the threshold is not a positive number.
    """
    known = provenance or Provenance()
    if threshold is None:
        return Assessment(options.kind.name, _certificate(trials, options, known))
    if counterexample(trials, threshold) is None:
        verdict = judge(trials, threshold, options, known)
        if verdict.certificate is None:
            raise CertificateError(verdict.reason)
        return Assessment(options.kind.name, verdict.certificate, verdict)
    try:
        certificate = _certificate(trials, options, known, threshold)
    except CertificateError as error:
        return Assessment(options.kind.name, None, counterexample(trials, threshold), str(error))
    return Assessment(options.kind.name, certificate, judge_by(certificate, trials, threshold))


def _certificate(
    trials: Sequence[Trial], options: CertificateOptions, known: Provenance, threshold: float | None = None
) -> Certificate:
    sample, kind = known.sample(trials), options.kind
    if threshold is not None and (kind.needs_threshold or kind.uses_threshold):
        found, _ = kind.certify_against(sample, threshold, options.confidence)
    else:
        found = kind.certify(sample, options.confidence)
    return found.with_remarks(known.remarks)
