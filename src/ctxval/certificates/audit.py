"""An audit: independent draws bound the share of tasks whose distance is larger than the largest one known.

It assumes nothing about how the distance depends on the task, or about how the worst known task was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.checked import Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import ONE_CAMPAIGN, Certificate, CertificateKind
from ctxval.certificates.bounds import at_most, of_tasks
from ctxval.certificates.draws import countable_draws, draws_left_out, how_drawn, not_counted
from ctxval.certificates.sample import Sample, advice_to_remeasure
from ctxval.certificates.scenario import ABOUT_DRAWS, rests_on_draws, violations, volume_bound
from ctxval.core.space import TaskSpace
from ctxval.errors import CertificateError


@part("audit")
@dataclass(frozen=True, repr=False)
class Audit(CertificateKind):
    """Bound on all tasks except a share of the task space, from the independent draws among the trials."""

    name: ClassVar[str] = "audit"
    bounds_maximum: ClassVar[bool] = False

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_audit` of the trials."""
        return certify_audit(sample, confidence)

    @classmethod
    def rests_on(cls, certificate: Certificate, space: TaskSpace | None = None) -> list[str]:
        """Return what it assumes about the draws."""
        return rests_on_draws(certificate)

    @classmethod
    def shortfall(cls, certificate: Certificate) -> str:
        """Return how many draws do not count; empty if all count."""
        return draws_left_out(certificate)


@checked
def certify_audit(sample: Sample, confidence: Probability = 0.95) -> Certificate:
    """Return a bound on the volume of the tasks whose distance exceeds the largest one known, from independent draws.

    Let h be the largest of N independent distances. The volume of tasks above h is bounded for any distance function.
    The largest distance of all trials is at least h, so the volume above it is not larger, however those trials were
    chosen. If the number of draws was raised after some were known, only the draws of the last decision count, since
    only their number was chosen before they were executed.

    Args:
        sample: trials of any origin; some of them must be independent draws.
        confidence: 1 - beta, the probability with which the statement holds.

    Raises:
        CertificateError: if there is no independent draw, if the number of draws depended on their distances, or if
            the execution of a draw failed.
    """
    beta = 1 - confidence
    drawn = countable_draws(sample, "an audit")
    _require_distances(drawn)
    volume, h = volume_bound(len(drawn), 0, beta), sample.best
    return Certificate(
        kind="audit",
        statement=(
            f"With confidence {confidence}, at most {at_most(100 * volume, 3)} % "
            f"{of_tasks(sample.distribution)} has a distance above {at_most(h)}, the largest one found."
        ),
        upper_bound=h,
        confidence=confidence,
        volume=volume,
        trials=len(drawn),
        assumptions=(
            *how_drawn(sample, drawn),
            *ABOUT_DRAWS,
            *sample.remarks,
            ONE_CAMPAIGN,
        ),
        details={
            **{"largest_found": h, **_against_the_search(sample, drawn)},
            **{"not_counted": not_counted(sample, drawn), "failed": sample.failed, "failures": sample.failures},
        },
        distribution=sample.distribution,
    )


def _require_distances(drawn: Sample) -> None:
    """Refuse draws without a distance."""
    if drawn.failed:
        raise CertificateError(
            f"{violations(drawn)}; to audit the other tasks, start a new store whose task space excludes these tasks."
            f"{advice_to_remeasure(drawn)}"
        )


def _against_the_search(sample: Sample, drawn: Sample) -> dict[str, float | int | None]:
    """Return the largest distance of the draws and of all other trials, and how many draws exceed the latter."""
    chosen = sample.distances[[origin != "iid" for origin in sample.origins]]
    if not np.isfinite(chosen).any():
        return {"largest_drawn": drawn.best, "largest_chosen": None, "exceeding": None}
    largest = float(np.nanmax(chosen))
    return {
        "largest_drawn": drawn.best,
        "largest_chosen": largest,
        "exceeding": int((drawn.distances > largest).sum()),
    }
