"""An audit: independent draws bound the share of tasks whose distance is larger than the largest one known.

It assumes nothing about how the distance depends on the task, or about how the worst known task was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.checked import Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.bounds import at_most
from ctxval.certificates.sample import Sample, advice_to_remeasure
from ctxval.certificates.scenario import volume_bound
from ctxval.certificates.sentences import ABOUT_DRAWS, ONE_CAMPAIGN, how_drawn, share_above, violations
from ctxval.errors import CertificateError


def countable_draws(sample: Sample, kind: str) -> Sample:
    """Return the independent draws whose number was chosen before they were executed; ``kind`` is for messages.

    Raises:
        CertificateError: if there is none.
    """
    everything, drawn = len(sample.only("iid")), sample.rows(sample.countable)
    if not everything:
        raise CertificateError(f"{kind} needs independent draws of tasks, but there is none; run certify --audit N.")
    if not len(drawn):
        raise CertificateError(
            f"the {everything} independent draws ended with the verdict, so their number depended on their distances "
            "and none counts; certify --audit N draws until there are N in all, and counts only those after the first "
            f"{everything}."
        )
    return drawn


def not_counted(sample: Sample) -> int:
    """Return the number of independent draws that do not count."""
    return len(sample.only("iid")) - len(sample.countable)


@part("audit")
@dataclass(frozen=True, repr=False)
class Audit(CertificateKind):
    """Bound on all tasks except a share of the task space, from the independent draws among the trials."""

    name: ClassVar[str] = "audit"
    bounds_maximum: ClassVar[bool] = False
    sorts_draws: ClassVar[bool] = True

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_audit` of the trials."""
        return certify_audit(sample, confidence)


@checked
def certify_audit(sample: Sample, confidence: Probability = 0.95) -> Certificate:
    """Return a bound on the volume of the tasks whose distance exceeds the largest one known, from independent draws.

    Let h be the largest of N independent distances. The volume of tasks above h is bounded for any distance function.
    The largest distance of all trials is at least h, so the volume above it is not larger, however those trials were
    chosen. Only draws count whose number was chosen before they were executed (:attr:`Sample.countable`).

    Raises:
        CertificateError: if no independent draw counts, or the execution of a draw failed.
    """
    drawn = countable_draws(sample, "an audit")
    if drawn.failed:
        raise CertificateError(
            f"{violations(drawn)}; to audit the other tasks, start a new store whose task space excludes these tasks."
            f"{advice_to_remeasure(drawn)}"
        )
    volume, h = volume_bound(len(drawn), 0, 1 - confidence), sample.best
    chosen = sample.distances[[origin != "iid" for origin in sample.origins]]
    largest = float(np.nanmax(chosen)) if np.isfinite(chosen).any() else None
    return Certificate(
        kind="audit",
        statement=share_above(sample, volume, confidence, at_most(h), len(drawn), ", the largest one found"),
        upper_bound=h,
        confidence=confidence,
        volume=volume,
        trials=len(drawn),
        assumptions=(*how_drawn(sample, drawn), *ABOUT_DRAWS, *sample.remarks, ONE_CAMPAIGN),
        details={
            "largest_found": h,
            "largest_drawn": drawn.best,
            "largest_chosen": largest,
            "exceeding": None if largest is None else int((drawn.distances > largest).sum()),
            "not_counted": not_counted(sample),
            "failed": sample.failed,
            "failures": sample.failures,
        },
        distribution=sample.distribution,
    )
