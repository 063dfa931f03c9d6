"""What trials prove: a certificate, and against a threshold a verdict. It is what ``ctxval certify`` reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ctxval._util.representation import record
from ctxval.certificates.base import Certificate
from ctxval.certificates.options import CertificateOptions
from ctxval.certificates.provenance import Provenance
from ctxval.certificates.sample import Sample
from ctxval.certificates.verdict import Verdict, counterexample, judge, judge_by
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError


@dataclass(frozen=True, eq=False)
class Assessment:
    """A certificate and a verdict of the same trials.

    Attributes:
        kind: the name of the certificate's kind.
        certificate: None if its theory refuses the trials.
        verdict: None without a threshold.
        refusal: why there is no certificate.
    """

    kind: str
    certificate: Certificate | None
    verdict: Verdict | None = None
    refusal: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        said = {} if self.verdict is None else self.verdict.to_json()
        expected = None if self.verdict is None or self.verdict.expected is None else asdict(self.verdict.expected)
        refused = {"kind": self.kind, "refused": self.refusal}
        proved = refused if self.certificate is None else self.certificate.to_json()
        return {**said, **proved, "expected": expected}

    def __repr__(self) -> str:
        return record(self)


def assess(
    trials: Sequence[Trial],
    options: CertificateOptions,
    threshold: float | None = None,
    provenance: Provenance | None = None,
) -> Assessment:
    """Return what trials prove.

    An executed counterexample stands without any certificate; a certificate is attempted all the same.

    Args:
        trials: all of them.
        options: by which certificate.
        threshold: tau, in the distance's units; without it there is no verdict.
        provenance: what else is known of the campaign.

    Raises:
        CertificateError: the certificate's theory refuses the trials, and none of them exceeds the threshold.
        InputError: the threshold is not a positive number.
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
    sample, kind = Sample.of(trials, known.search), options.kind
    if threshold is not None and kind.needs_threshold:
        found, _ = kind.certify_against(sample, threshold, options.confidence)
    else:
        found = kind.certify(sample, options.confidence)
    return found.with_remarks(known.remarks)
