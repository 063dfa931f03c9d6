"""The largest distance of a suite of tasks, all of which were executed: nothing is left to be bounded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ctxval._util.registry import part
from ctxval._util.representation import counted
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.sample import Sample
from ctxval.certificates.sentences.statements import EXECUTED_AGAIN
from ctxval.errors import CertificateError


@part("suite")
@dataclass(frozen=True, repr=False)
class WholeSuite(CertificateKind):
    """The largest distance of a suite of tasks, all of which were executed."""

    name: ClassVar[str] = "suite"
    takes_suites: ClassVar[bool] = True

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the certificate; the largest executed distance is the largest of all."""
        missing = sample.not_executed
        if missing is None:
            raise CertificateError("tasks fill a box here, so they cannot all be executed; this kind is for a suite.")
        if missing:
            raise CertificateError(
                f"{missing} of {counted(sample.tasks or 0, 'task')} of the suite have no distance yet, so the largest "
                "one is not known; `ctxval run` executes them."
            )
        return Certificate(
            kind=self.name,
            statement=f"All {sample.tasks} tasks of the suite were executed, and their largest distance is "
            f"{sample.best:.6g}.",
            upper_bound=sample.best,
            confidence=confidence,
            volume=0.0,
            trials=len(sample),
            assumptions=(EXECUTED_AGAIN, *sample.remarks),
            details={"best": sample.best, "tasks": sample.tasks, "failures": sample.failures},
        )
